"""Observers from recorded states, where nobody knows the equations: ``kkl-gym train --data``."""
