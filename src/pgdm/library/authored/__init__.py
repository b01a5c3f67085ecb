"""The user's own objects and motions."""
