"""Which of several services on one database writes."""
