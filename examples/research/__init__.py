"""The comparisons behind the pages of results: observers, agents, speed. They run only in a clone."""
