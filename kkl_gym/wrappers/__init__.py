"""Wrappers: a learned observer in an environment, a memory around any, agents that act more slowly than it samples."""
