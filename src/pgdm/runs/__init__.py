"""Run folders: their files, records and result, and the versions behind a result."""
