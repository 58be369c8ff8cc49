"""Wrappers: a learned observer in an environment, a memory around any environment, and actions held over steps."""
