"""The tests of EVSE Bus."""
