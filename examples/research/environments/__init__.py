"""Agents in environments of others that are shown different things, compared."""
