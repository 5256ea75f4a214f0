"""Which names in a pickle only an attack asks for; everything else is let be, since nothing in a pickle is ever run.

Refusing a file is a warning to its user, not the protection: that is `pickles`, which calls nothing. So a name is refused
that runs commands, code or files, and one that is only a way to other names (`getattr`) is judged by where it leads.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


# Words of a dotted name are compared without underscores in front: modules import each other as `_os`, `_io`, `_shutil`.
_UNSAFE_MODULES = _words(  # as the first word
    "os posix nt subprocess sys pty runpy shutil socket webbrowser importlib imp ctypes cffi code codeop pdb bdb timeit "
    "profile cProfile asyncio multiprocessing thread pickle cPickle marshal types urllib urllib2 http httplib ftplib "
    "smtplib imaplib poplib telnetlib xmlrpc ssl requests aiohttp paramiko pexpect pip ensurepip venv io operator pkgutil "
    "zipimport doctest commands popen2 pydoc pyrepl frozen_importlib frozen_importlib_external posixsubprocess winapi "
    "distutils setuptools unittest idlelib lib2to3 cgitb aix_support osx_support shelve dbm linecache fileinput "
    "antigravity turtle dill cloudpickle joblib testcapi rlcompleter"
)
_UNSAFE_BUILTINS = _words(
    "eval exec execfile compile open file __import__ getattr setattr delattr globals locals vars input raw_input "
    "breakpoint apply exit quit help"
)
_UNSAFE_INSIDE = _words(  # as any word: modules that others import, which no project names its own after
    "os posix nt sys subprocess importlib builtins builtins__ globals__ shutil socket ctypes cffi pty runpy pickle cPickle "
    "marshal webbrowser pdb bdb urllib pkgutil zipimport pydoc distutils pip cpp_extension codecache f2py joblib dill "
    "cloudpickle posixsubprocess"
)
_UNSAFE_LAST = _words(  # as the last word: functions that run commands, code or files, wherever they are defined
    "eval exec execfile execWrapper exec_with_source system popen Popen startfile spawn posix_spawn posix_spawnp fork "
    "forkpty fork_exec kill killpg spawnl spawnle spawnlp spawnlpe spawnv spawnve spawnvp spawnvpe execl execle execlp "
    "execlpe execv execve execvp execvpe import__ import_module gcd_import importer import_string import_item resolve_name "
    "resolve_dotted_attribute locate instantiate run_path run_module runstring runctx run_cprofile loadGrammar "
    "get_command_stdout read_cmd_output read_output pipepager pipe_pager tempfilepager reduce_graph_module "
    "reduce_package_graph_module forward_from_src evaluate_guards_expression open fdopen urlopen urlretrieve rmtree unlink "
    "rmdir removedirs write_text write_bytes mkstemp FileIO read_pickle FunctionType LambdaType CodeType methodcaller "
    "attrgetter getattr setattr delattr getattr_static CDLL PyDLL dlopen load_library PackageImporter"
)
_UNSAFE_PAIRS = _words(  # as two words after each other
    "torch.load torch.hub torch.package serialization.load serialization.legacy_load jit.load jit.unsupported_tensor_ops "
    "utils.bottleneck utils.collect_env utils.config_module numpy.testing numpy.distutils numpy.load numpy.save "
    "numpy.fromfile np.load np.save np.fromfile np.testing trace.Trace test.support logging.config logging.FileHandler "
    "site.addpackage site.addsitedir sqlite3.connect gc.get_objects gc.get_referrers signal.raise_signal sh.Command "
    "hydra.call utils.call decoder.basichandlers guards.GuardBuilder"
)
_WAYS_OUT = _words(  # from any object to all others; no setting is reached through them
    "__builtins__ __globals__ __dict__ __class__ __base__ __bases__ __mro__ __subclasses__ __getattribute__ __code__ "
    "__closure__ __loader__ __spec__ __import__ __self__ __func__ __wrapped__"
)
# Attributes: the same words, fewer those that honest classes have too (`Function.apply`, `Config.types`).
_COMMON = _words(
    "apply compile input file vars io code types profile timeit requests commands http help exit quit locate instantiate"
)
_UNSAFE_ATTRIBUTES = (
    _UNSAFE_MODULES | _UNSAFE_BUILTINS | _UNSAFE_INSIDE | _UNSAFE_LAST | _WAYS_OUT | _words("hub")
) - _COMMON
_GETATTR = _words("builtins.getattr __builtin__.getattr")
_ATTRGETTER = _words("operator.attrgetter _operator.attrgetter")
_ITEMGETTER = _words("operator.itemgetter _operator.itemgetter")
_OPERATORS = _words("itemgetter getitem or_ and_ xor not_ neg add sub mul truediv floordiv mod pow eq ne lt le gt ge")
# How Python writes down nested classes, methods, `list[int]`, `int | str` and sort keys.
_HARMLESS = (
    _GETATTR
    | _ATTRGETTER
    | {f"{module}.{name}" for module in ("operator", "_operator") for name in _OPERATORS}
    | _words("io.BytesIO _io.BytesIO io.StringIO _io.StringIO types.SimpleNamespace types.MappingProxyType")
    | _words("types.GenericAlias types.UnionType types.NoneType")
    | {f"numpy.random._pickle.__{kind}_ctor" for kind in ("generator", "bit_generator", "randomstate")}
)


def is_unsafe(name: str) -> bool:
    """Whether a global is one that only an attack asks for: `posix.system`, `builtins.eval`, `random._os.system`."""
    if name in _HARMLESS:
        return False
    parts = name.split(".")
    bare = _bare(name)
    if parts[0] in ("builtins", "__builtin__") and not _UNSAFE_BUILTINS.isdisjoint(parts[1:]):
        return True
    return (
        bare[0] in _UNSAFE_MODULES
        or bare[-1] in _UNSAFE_LAST
        or not _UNSAFE_INSIDE.isdisjoint(bare[1:])
        or not _WAYS_OUT.isdisjoint(parts[1:])
        or not _UNSAFE_PAIRS.isdisjoint(map(".".join, pairwise(bare)))
    )


def is_unsafe_attribute(path: str) -> bool:
    """Whether an attribute, or one of a dotted path of them, leads to what only an attack asks for: `_os`, `__globals__`."""
    return not _UNSAFE_ATTRIBUTES.isdisjoint(path.split(".")) or not _UNSAFE_ATTRIBUTES.isdisjoint(_bare(path))


def _bare(path: str) -> list[str]:
    """The words of a dotted name without underscores in front."""
    words = path.split(".")
    return [word.lstrip("_") for word in words] if "_" in path else words


def is_getattr(name: str) -> bool:
    """Whether a global is the function `getattr`, whose call names another global."""
    return name in _GETATTR


def is_way(name: str) -> bool:
    """Whether a global is a function from names to attributes: let be when called directly, an attack anywhere else."""
    return name in _GETATTR or name in _ATTRGETTER


def is_getter(name: str) -> bool:
    """Whether a class is one of functions that fetch an item or attribute: settings hold them, only attacks call them."""
    return name in _ITEMGETTER or name in _ATTRGETTER


def attributes_of(name: str, arguments: Sequence[Any]) -> Sequence[Any]:
    """The attributes that calling `getattr` or `attrgetter` (their name) with `arguments` asks for."""
    return arguments[1:2] if name in _GETATTR else arguments
