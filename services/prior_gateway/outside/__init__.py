"""What the gateway touches outside: models, disk, keys, the shipped library."""
