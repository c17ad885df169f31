"""What is wrong with a set-up, and what mends it: facts of this host and of the bus, and what follows from them."""
