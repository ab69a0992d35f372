"""Tests of the ABL protocol."""
