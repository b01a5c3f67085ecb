"""MuJoCo's bindings are compiled and ship no types, so that its names are Any to the checker.

Stubs made from the bindings by a generator were tried: they refuse valid code, such as a list
assigned to a body's position.
"""

from typing import Any

def __getattr__(name: str) -> Any: ...
