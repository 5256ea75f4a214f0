"""Teachers: 2-D encoders whose dense features are distilled into a field."""

from .load import load_teacher
from .prompts import make_label_set
from .protocol import CallableTeacher, Teacher

__all__ = ["CallableTeacher", "Teacher", "load_teacher", "make_label_set"]
