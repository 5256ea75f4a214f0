"""Teachers: 2-D encoders whose dense features are distilled into a field."""

from .checkpoint import read_checkpoint
from .load import load_teacher, teacher_names
from .prompts import make_label_set
from .protocol import CallableTeacher, Teacher, as_teacher, identify

__all__ = [
    "CallableTeacher",
    "Teacher",
    "as_teacher",
    "identify",
    "load_teacher",
    "make_label_set",
    "read_checkpoint",
    "teacher_names",
]
