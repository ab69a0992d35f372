"""Sun and main fuse: the pure library."""
