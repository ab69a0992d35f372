"""EV chargers on serial buses, without Home Assistant.

Public: `protocols.PROTOCOLS` (how to make a bus of each protocol and find its
chargers), `bus.Bus`, `charger.Charger`, and the words of `model`. ``docs/library.md``
has a short script that reads and sets a charger.
"""
