"""The MDP over a batch of simulations, and its faces for learners."""
