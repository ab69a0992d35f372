"""The EWS-Box, as the manual has it."""
