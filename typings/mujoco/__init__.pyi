# MuJoCo's Python package ships no type information for its compiled modules: every name in it is Any to pyright.
from typing import Any

def __getattr__(name: str) -> Any: ...
