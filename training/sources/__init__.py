"""Where motions come from: equations, records, or rollouts of an environment."""
