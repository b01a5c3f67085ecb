"""Results as a page, tables and pictures, beside the paper's figures and what doing nothing gives."""
