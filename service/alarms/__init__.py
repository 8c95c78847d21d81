"""WHEN TO CALL SOMEBODY: the quantities that are watched, their limits, and how alarms live."""
