"""Messages of the EWS-Box: frames, records, commands and answers; no conversations."""
