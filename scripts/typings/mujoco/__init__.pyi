# mujoco's bindings are compiled and ship no types: whatever they hold is Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
