"""Agents that learn to act: the online trial loop, the offline learner, and what wires them."""
