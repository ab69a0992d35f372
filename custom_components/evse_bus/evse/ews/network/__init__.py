"""EWS-Boxes that dial: the listener, and the line of each box."""
