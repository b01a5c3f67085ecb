"""Results as a page, tables and figures, next to the paper and to a policy that does nothing."""
