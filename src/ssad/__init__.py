"""SSAD: how safe and robust is an autonomous-driving system in safety-critical scenarios?"""

from __future__ import annotations

__version__ = "0.1.0"
