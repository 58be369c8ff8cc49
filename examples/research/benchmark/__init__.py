"""The comparison of observers: protocol, jobs, tables and figure."""
