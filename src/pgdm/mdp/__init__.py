"""The MDP as short pure functions: observations, actions, rewards, terminations, metrics."""
