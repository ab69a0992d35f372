"""Sun and main fuse: how much each charger may offer, and why.

Pure: times and numbers in, ceilings and reasons out. It has no clock and no loop, and
imports nothing of Home Assistant and nothing of `evse/`. All times are seconds on one
clock of the caller; powers are W, currents A per phase.
"""
