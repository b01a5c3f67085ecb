"""Hands of the user's, made from MJCF or URDF."""

from __future__ import annotations

from pgdm.author.hand.make import AuthoredHand, HandRequest, author_hand, remove_hand

__all__ = ["AuthoredHand", "HandRequest", "author_hand", "remove_hand"]
