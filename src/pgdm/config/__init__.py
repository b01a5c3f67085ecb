"""Settings: their types, their values from ``conf/``, and what identifies an experiment."""
