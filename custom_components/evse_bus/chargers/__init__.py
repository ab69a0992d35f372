"""The chargers of a bus in Home Assistant: what stands between subentry and library."""
