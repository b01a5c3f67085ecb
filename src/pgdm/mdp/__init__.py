"""The MDP as short pure functions: observations, actions, rewards, ends, metrics."""
