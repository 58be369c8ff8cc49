"""CPU times of steps of environments and observers."""
