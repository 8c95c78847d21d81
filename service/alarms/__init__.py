"""Alarms: the states of an alarm."""
