"""Results as a page, tables and pictures, beside the paper's and those of doing nothing."""
