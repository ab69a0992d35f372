"""The demo: virtual buses and a real Home Assistant that knows them.

Started by ``scripts/demo``; `__main__` tells the story. Everything it makes is in
one folder, and nothing of it is needed by the integration.
"""
