"""How long steps of environments and observers take."""
