"""From when on compiling is worth the seconds that it takes."""

MANY_ROWS = 128  # of a batch
SOON = 1000  # single samples, after which a simulation will go on for long enough
