"""Alarms: the monitored quantities, their limits, and the states of an alarm."""
