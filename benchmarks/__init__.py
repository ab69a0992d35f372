"""Figures of EVSE Bus: how fast, how punctual, at what cost. See README.md."""
