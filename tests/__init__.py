"""Tests of fflin, in the rooms of the code."""
