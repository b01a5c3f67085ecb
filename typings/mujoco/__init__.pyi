"""MuJoCo's bindings are compiled and ship no types; its names are Any to the type checker.

Stubs generated from the bindings reject valid code, such as assigning a list to a body's position.
"""

from typing import Any

def __getattr__(name: str) -> Any: ...
