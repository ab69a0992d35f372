"""The demo: virtual buses, and a real Home Assistant with all of them set up.

Started by ``scripts/demo``; begin to read at `__main__`. Everything it creates is in one
folder, and the integration needs nothing of it.
"""
