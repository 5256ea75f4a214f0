"""Teachers: 2-D encoders whose dense features are distilled into a field."""

from .bpe import Tokenizer, load_tokenizer
from .checkpoint import read_checkpoint, weights_digest
from .load import load_teacher, teacher_names
from .lseg import LSeg, LSegConfig, LSegOptions, load_lseg
from .prompts import TEMPLATES, embed_labels, make_label_set
from .protocol import CallableTeacher, Teacher, as_teacher, identify
from .sam import SamTeacher, load_sam
from .transformers_table import TRANSFORMERS
from .transformers_teacher import TransformersTeacher, load_transformers_teacher

__all__ = [
    "TEMPLATES",
    "TRANSFORMERS",
    "CallableTeacher",
    "LSeg",
    "LSegConfig",
    "LSegOptions",
    "SamTeacher",
    "Teacher",
    "Tokenizer",
    "TransformersTeacher",
    "as_teacher",
    "embed_labels",
    "identify",
    "load_lseg",
    "load_sam",
    "load_teacher",
    "load_tokenizer",
    "load_transformers_teacher",
    "make_label_set",
    "read_checkpoint",
    "teacher_names",
    "weights_digest",
]
