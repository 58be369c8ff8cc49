"""Learning the maps: networks, coordinates, the forward map T, its inverse T_inv, and their batches."""
