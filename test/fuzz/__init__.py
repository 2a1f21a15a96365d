"""Gives damaged files and messages to all that reads data from outside."""
