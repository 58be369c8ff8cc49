"""How long steps take, and how small maps can be."""
