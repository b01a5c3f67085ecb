"""Pre-grasps posed by a person: the model behind the page, and the page in the browser."""
