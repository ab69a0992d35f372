"""Actions of an EWS-Box: the meaning of their fields, one file for each subject."""
