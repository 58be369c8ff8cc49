"""The commands of ``kkl-gym``, one in each module."""
