"""Agents in any environment, of which they see a part: what they are shown, how they learn, who acts how well."""
