"""P-CHARGE EWS-Box: MCS binary over RS-232 or TCP, two charge ports a box."""
