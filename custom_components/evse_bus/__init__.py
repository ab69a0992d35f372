"""EVSE Bus: EV chargers on serial buses."""
