"""Steps and forms of the dialogues that config_flow.py starts."""
