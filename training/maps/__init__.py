"""Learning the maps: networks, coordinates, batches, the forward map T, its inverse, and the optimisation loop."""
