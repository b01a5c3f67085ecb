"""Results as a page, tables and figures, compared with the paper and with doing nothing."""
