"""Ids of runs, uploads and sessions."""

import re
import secrets

PATTERN = "^[0-9a-f]{12}$"
ID = re.compile(PATTERN)


def new_id() -> str:
    """A new, unguessable id."""
    return secrets.token_hex(6)
