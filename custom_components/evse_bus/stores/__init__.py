"""What is kept across restarts: files in the storage folder of Home Assistant."""
