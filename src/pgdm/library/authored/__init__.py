"""The library source ``own``: the user's objects, hands and motions."""
