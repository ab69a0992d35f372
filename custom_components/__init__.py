"""Makes this folder a package: the test plugin has one of the same name."""
