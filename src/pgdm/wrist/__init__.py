"""Where the wrist should go for the object to follow its exemplar motion."""
