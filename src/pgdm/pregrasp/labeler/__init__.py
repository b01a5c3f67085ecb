"""The labeler: a page in the browser on which a person poses a pre-grasp."""
