"""Agents on our systems that know different things, compared."""
