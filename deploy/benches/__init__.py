"""Measurements that fill a module of their own."""
