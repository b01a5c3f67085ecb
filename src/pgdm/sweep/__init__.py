"""Many experiments as one: what is planned, what was done, and what is left to do."""
