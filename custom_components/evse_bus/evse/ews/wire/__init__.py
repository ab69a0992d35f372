"""Messages of MCS binary: frames, records, commands and answers. Pure functions."""
