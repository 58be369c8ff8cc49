"""Parameters and observers from records of outputs."""
