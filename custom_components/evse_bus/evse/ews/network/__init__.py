"""Boxes that dial over the network: the listener, and the line of each box."""
