"""What an error message must tell, without pinning its prose."""

import re


def tells(*parts: object) -> str:
    """A pattern for `match=`: the message holds every part, in any order: the argument's name, what came, what to do."""
    return "(?s)" + "".join(f"(?=.*{re.escape(str(part))})" for part in parts)
