"""What observers that are there learn on top: to notice faults, to say how far off they may be, and to track."""
