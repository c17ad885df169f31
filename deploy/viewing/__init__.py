"""The live page: a scene as pictures in three dimensions and words, from a running system or from a file."""
