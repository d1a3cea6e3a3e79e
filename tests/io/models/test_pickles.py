import builtins
import io
import os
import pickle
import struct
import subprocess
import sys
import time
import tracemalloc
import types
import zipfile
from collections import OrderedDict

import numpy as np
import pytest
import scipy.sparse
import torch

from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body
from habitus.io.models.pickled_arrays import as_array
from habitus.io.models.pickles import read_pickle


def read(data: bytes):
    return read_pickle(io.BytesIO(data))


ARRAYS = [
    np.arange(24.0).reshape(2, 3, 4),
    np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
    np.arange(5, dtype=">i4"),
    np.arange(6, dtype=np.uint32)[::2],
    np.array([True, False]),
    np.array(3.5),
    np.float64(2.5),
    np.float32(0.1),
    np.zeros((0, 3)),
    np.float16([1, 2]),
    7.0,
    [1, 2, 3],
]


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_come_back_at_every_protocol(protocol):
    content = read(pickle.dumps(OrderedDict(a=ARRAYS, b="text"), protocol))
    for found, array in zip(content["a"], ARRAYS, strict=True):
        found = as_array(found)
        assert np.array_equal(found, array) and found.dtype.kind == np.asarray(array).dtype.kind
    assert str(as_array(content["b"])) == "text"


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("kind", ["csc_matrix", "csr_matrix", "csc_array", "csr_array"])
def test_sparse_matrices_become_dense(kind, protocol):
    dense = np.round(np.random.default_rng(0).normal(size=(4, 7))) * [[0], [1], [1], [1]]
    sparse = getattr(scipy.sparse, kind)(dense)
    assert np.array_equal(as_array(read(pickle.dumps(sparse, protocol))), dense)


@pytest.fixture
def chumpy():
    """A package of that name to pickle with, gone when the file is read."""
    package, ch, reordering = (
        types.ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")
    )
    ch.Ch = type("Ch", (), {"__module__": "chumpy.ch"})
    reordering.Select = type("Select", (ch.Ch,), {"__module__": "chumpy.reordering"})
    sys.modules |= {"chumpy": package, "chumpy.ch": ch, "chumpy.reordering": reordering}

    def dumps(content, protocol=2):
        data = pickle.dumps(content, protocol)
        for name in ("chumpy", "chumpy.ch", "chumpy.reordering"):
            sys.modules.pop(name, None)
        return data

    yield types.SimpleNamespace(Ch=ch.Ch, Select=reordering.Select, dumps=dumps)
    for name in ("chumpy", "chumpy.ch", "chumpy.reordering"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
def test_chumpy_gives_its_arrays_without_chumpy(chumpy, protocol):
    values = np.arange(60.0).reshape(5, 4, 3)
    plain = chumpy.Ch()
    chosen = chumpy.Select()
    other = chumpy.Ch()
    plain.__dict__ |= {"x": values, "_dirty_vars": {"x"}, "_itr": None}
    wanted = np.arange(60).reshape(5, 4, 3)[..., :2]
    chosen.__dict__ |= {"a": plain, "idxs": wanted.ravel(), "preferred_shape": wanted.shape}
    other.__dict__ |= {"terms": 3}
    content = read(chumpy.dumps({"plain": plain, "chosen": chosen, "other": other}, protocol))
    assert "chumpy" not in sys.modules
    assert np.array_equal(as_array(content["plain"]), values)
    assert np.array_equal(as_array(content["chosen"]), values[..., :2])
    with pytest.raises(HabitusError, match=r"chumpy\.ch\.Ch"):
        as_array(content["other"])


def test_python_2_files_keep_bytes_as_text():
    values = np.array([[1.5, -2.25, 3e300], [0.0, 7.0, -1e-300]])
    raw = values.tobytes()
    array = (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR(K\x01(K\x02K\x03t"
        b"cnumpy\ndtype\n(U\x02f8K\x00K\x01tR(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89T"
        + struct.pack("<i", len(raw))
        + raw
        + b"tb"
    )
    boxed = b"ccopy_reg\n_reconstructor\n(cchumpy.ch\nCh\nc__builtin__\nobject\nNtR}(U\x01x" + array
    boxed += b"U\x05dirtyc__builtin__\nset\n(]tRub"
    content = read(b"\x80\x02}(U\x01a" + array + b"U\x01b" + boxed + b"u.")
    assert np.array_equal(as_array(content["a"]), values) and np.array_equal(
        as_array(content["b"]), values
    )


class Calls:
    """Pickles as a call of a function, which an ordinary unpickler would make."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


def attacks(folder):
    mark = str(folder / "ran")
    return {
        "os.system|posix.system|nt.system": Calls(os.system, f"echo > {mark}"),
        "builtins.eval": Calls(eval, f"open({mark!r}, 'w')"),
        "builtins.exec": Calls(exec, f"open({mark!r}, 'w')"),
        "builtins.getattr": Calls(getattr, "", "join"),
        "io.open|_io.open": Calls(open, mark, "w"),
        "subprocess.Popen|commands.Popen": Calls(subprocess.Popen, ["touch", mark]),
        "numpy.load|numpy.lib._npyio_impl.load": Calls(np.load, mark),
        "torch._utils|torch.storage": torch.zeros(3),
        "builtins.__import__": Calls(builtins.__import__, "antigravity"),
        "builtins.bytearray": bytearray(b"x"),
        "pathlib": folder,
    }


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_nothing_in_a_pickle_runs(protocol, tmp_path):
    for names, attack in attacks(tmp_path).items():
        path = tmp_path / "model.pkl"
        path.write_bytes(pickle.dumps({"v_template": attack}, protocol))
        with pytest.raises(HabitusError, match="nothing was run") as caught:
            load_body(path)
        assert any(name in str(caught.value) for name in names.split("|")), names
        assert "model.pkl" in str(caught.value) and not (tmp_path / "ran").exists()


def short(text: bytes) -> bytes:
    return b"\x8c" + bytes([len(text)]) + text


ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85U\x01btR"
DTYPE = b"cnumpy\ndtype\n(U\x02O8K\x00K\x01tR(K\x03U\x01|NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK?tb"
ESCAPES = {  # each would run os.system, or reach it, in an ordinary unpickler
    "GLOBAL": b"cos\nsystem\n(S'true'\ntR.",
    "GLOBAL of a dotted name": b"cnumpy\nndarray.__class__\n.",
    "GLOBAL of posix": b"cposix\nsystem\n.",
    "GLOBAL in Python 2's words": b"c__builtin__\neval\n(S'1'\ntR.",
    "STACK_GLOBAL": b"\x80\x04"
    + short(b"os")
    + short(b"system")
    + b"\x93"
    + short(b"true")
    + b"\x85R.",
    "STACK_GLOBAL of a dotted name": b"\x80\x04"
    + short(b"numpy")
    + short(b"dtype.__base__.__subclasses__")
    + b"\x93.",
    "STACK_GLOBAL of no texts": b"\x80\x04K\x01K\x02\x93.",
    "STACK_GLOBAL of a module in a module": b"\x80\x04"
    + short(b"numpy.core.multiarray.os")
    + short(b"system")
    + b"\x93.",
    "INST": b"(S'true'\nios\nsystem\n.",
    "OBJ": b"(cos\nsystem\nS'true'\no.",
    "NEWOBJ": b"\x80\x02csubprocess\nPopen\n]\x81.",
    "NEWOBJ_EX": b"\x80\x04csubprocess\nPopen\n)}\x92.",
    "REDUCE of a text": b"S'os.system'\n(S'true'\ntR.",
    "REDUCE of an array": ARRAY + b"(S'true'\ntR.",
    "BUILD of a class": b"cnumpy\nndarray\n}S'__reduce__'\ncos\nsystem\nsb.",
    "BUILD of a mapping": b"}}S'__class__'\ncos\nsystem\nsb.",
    "BUILD of a number": b"K\x01}b.",
    "EXT1": b"\x80\x02\x82\x01.",
    "EXT2": b"\x80\x02\x83\x01\x00.",
    "EXT4": b"\x80\x02\x84\x01\x00\x00\x00.",
    "PERSID": b"Pos.system\n.",
    "BINPERSID": b"S'os.system'\nQ.",
    "NEXT_BUFFER": b"\x80\x05\x97.",
    "READONLY_BUFFER": b"\x80\x05\x97\x98.",
    "getattr": b"cbuiltins\ngetattr\n(cos\nS'system'\ntR.",
    "operator.attrgetter": b"coperator\nattrgetter\n(S'system'\ntR.",
    "functools.partial": b"cfunctools\npartial\n(cos\nsystem\ntR.",
    "numpy's functions that call": b"cnumpy\nvectorize\n.",
    "numpy's functions that read files": b"cnumpy\nfromfile\n(S'/etc/passwd'\ntR.",
    "numpy.load": b"cnumpy\nload\n.",
    "numpy's f2py": b"cnumpy.f2py.crackfortran\nmyeval\n.",
    "numpy.testing": b"cnumpy.testing._private.utils\nrunstring\n.",
    "numpy's own access to attributes": b"cnumpy.core.multiarray\n_reconstruct.__globals__\n.",
    "scipy's loaders": b"cscipy.io\nloadmat\n.",
    "an array's method": b"cnumpy\nndarray.tofile\n(S'out'\ntR.",
    "torch": b"ctorch\nload\n.",
    "codecs": b"c_codecs\ndecode\n.",
    "copyreg's table": b"ccopyreg\nadd_extension\n.",
    "importlib": b"cimportlib\nimport_module\n.",
    "types": b"ctypes\nCodeType\n.",
    "bdb and pdb": b"cpdb\nrun\n.",
    "timeit": b"ctimeit\ntimeit\n.",
    "webbrowser": b"cwebbrowser\nopen\n.",
    "our own": b"chabitus.io.models.pickles\nread_pickle\n.",
    "an array of objects": ARRAY + b"(K\x01K\x01\x85" + DTYPE + b"\x89]cos\nsystem\natb.",
}


@pytest.mark.parametrize("name", ESCAPES)
def test_no_way_out_of_a_pickle_is_open(name, tmp_path, monkeypatch):
    called = []
    for module, function in (
        (os, "system"),
        (subprocess, "Popen"),
        (builtins, "eval"),
        (pickle, "loads"),
    ):
        monkeypatch.setattr(module, function, lambda *a, **k: called.append(a))
    for path, content in (("model.pkl", ESCAPES[name]), ("model.npz", None)):
        if content is None:
            with zipfile.ZipFile(tmp_path / path, "w") as archive:
                header = io.BytesIO()
                np.lib.format.write_array_header_1_0(
                    header, {"descr": "|O", "fortran_order": False, "shape": ()}
                )
                archive.writestr("v_template.npy", header.getvalue() + ESCAPES[name])
        else:
            (tmp_path / path).write_bytes(content)
        with pytest.raises(HabitusError, match=path.replace(".", r"\.")):
            load_body(tmp_path / path)
    assert not called


def nested(depth: int, wide: int) -> bytes:
    """Lists of one list many times over: 10 bytes a level, wide**depth entries when unfolded."""
    levels = b"".join(
        b"](" + (b"h" + bytes([k])) * wide + b"eq" + bytes([k + 1]) for k in range(depth)
    )
    return b"](K\x00K\x00eq\x00" + levels


LONG = b"y" * 100_000
AGAIN = b"K\x01sh\x00" * 100_000
BOMBS = {
    "a memo of four gigabytes": bytes.fromhex("80025d72ffffff0f2e"),
    "a memo of three gigabytes, in text": b"]p400000000\n.",
    "a long text that is not there": b"\x80\x04\x8d" + struct.pack("<Q", 2**40) + b"x.",
    "long bytes that are not there": b"\x80\x04\x8e" + struct.pack("<Q", 2**62) + b"x.",
    "a byte array that is not there": b"\x80\x05\x96" + struct.pack("<Q", 2**62) + b"x.",
    "a text of negative length": b"T\xff\xff\xff\xffx.",
    "a number of negative length": b"\x8b\xff\xff\xff\xff.",
    "a number of a million digits": b"L" + b"9" * 1_000_000 + b"L\n.",
    "a frame that is not there": b"\x80\x04\x95" + struct.pack("<Q", 2**63) + b"N.",
    "lists of lists of lists": b"}U\x0av_template" + nested(30, 60) + b"s.",
    "lists within lists": b"}U\x0av_template" + b"]" * 60_000 + b"a" * 59_999 + b"s.",
    "tuples within tuples as a key": b"}" + b")" + b"\x85" * 60_000 + b"K\x01s.",
    "a list within itself": b"}U\x0av_template]q\x00h\x00as.",
    "a tuple of tuples as a key": b"})" + b"2\x86" * 50_000 + b"K\x01s.",
    "a long number as a key, again and again": b"}\x8b\xa0\x86\x01\x00"
    + b"\x01" * 100_000
    + b"q\x00"
    + AGAIN
    + b".",
    "steps without end": b"N0" * 500_000 + b".",
    "one long text among many": b"}U\x0av_template]("
    + b"U\x01x" * 40_000
    + b"X\xa0\x86\x01\x00"
    + LONG
    + b"es.",
    "a sparse matrix of a terabyte": pickle.dumps(
        {"v_template": scipy.sparse.csc_matrix((10, 10))}, 2
    ).replace(b"K\nK\n\x86", b"J\xff\xff\xff\x0fJ\xff\xff\xff\x0f\x86"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_no_pickle_takes_memory_or_time_without_end(name, tmp_path):
    (tmp_path / "model.pkl").write_bytes(BOMBS[name])
    tracemalloc.start()
    started = time.process_time()
    try:
        with pytest.raises(HabitusError, match=r"model\.pkl"):
            load_body(tmp_path / "model.pkl")
        assert tracemalloc.get_traced_memory()[1] < 300_000_000
    finally:
        tracemalloc.stop()
    assert time.process_time() - started < 10


HAND_MADE = {
    "dotted name": b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93.",
    "dotted chumpy": b"\x80\x04\x8c\x09chumpy.ch\x8c\x09os.system\x93\x8c\x04true\x85R.",
    "old instance": b"(S'true'\nios\nsystem\n.",
    "old object": b"(cos\nsystem\nS'true'\no.",
    "extension": b"\x80\x02\x82\x01.",
    "persistent": b"Pmark\n.",
    "set item of a record": b"\x80\x02cchumpy.ch\nCh\n)\x81K\x01K\x02s.",
    "append to a record": b"\x80\x02cchumpy.ch\nCh\n)\x81K\x01a.",
    "call a record": b"\x80\x02cchumpy.ch\nCh\n)\x81)R.",
    "memo that is not there": b"\x80\x02h\x07.",
    "long text": b"\x80\x04\x8d" + struct.pack("<Q", 2**40) + b"x.",
    "no stop": b"\x80\x02}",
    "empty": b"",
}


@pytest.mark.parametrize("name", HAND_MADE)
def test_hand_made_pickles_end_in_one_clear_error(name, tmp_path):
    (tmp_path / "model.pkl").write_bytes(HAND_MADE[name])
    with pytest.raises(HabitusError, match=r"model\.pkl"):
        load_body(tmp_path / "model.pkl")


def test_damaged_records_end_in_one_clear_error(chumpy):
    around = chumpy.Select()
    around.__dict__ |= {"a": around, "idxs": np.arange(3)}
    far = chumpy.Select()
    far.__dict__ |= {"a": np.arange(3.0), "idxs": np.array([5])}
    content = read(chumpy.dumps({"around": around, "far": far}))
    for value in (*content.values(), object, {"a": 1}, None, np.array([{}]), [[1], [2, 3]]):
        with pytest.raises(HabitusError):
            as_array(value)
    lying = pickle.dumps(np.arange(6.0), 2).replace(b"K\x06\x85", b"K\x09\x85")
    with pytest.raises(HabitusError, match="damaged"):
        as_array(read(lying))
    objects = pickle.dumps(np.array([{}, {}]), 2)
    with pytest.raises(HabitusError, match="numbers"):
        as_array(read(objects))


def test_objects_inside_an_npz_are_read_the_same_way(tmp_path):
    from synthetic import official_arrays

    arrays = official_arrays("mano", 40)
    sparse = np.empty((), object)
    sparse[()] = scipy.sparse.csc_matrix(arrays["J_regressor"])
    hostile = np.empty((), object)
    hostile[()] = Calls(os.system, f"echo > {tmp_path / 'ran'}")
    np.savez(tmp_path / "model.npz", **(arrays | {"J_regressor": sparse, "joint2num": hostile}))
    body = load_body(tmp_path / "model.npz")  # what nobody asks for is never opened
    assert np.array_equal(body.joint_regressor, arrays["J_regressor"])
    np.savez(tmp_path / "model.npz", **(arrays | {"weights": hostile}))
    with pytest.raises(HabitusError, match=r"'weights'.*nothing was run"):
        load_body(tmp_path / "model.npz")
    assert not (tmp_path / "ran").exists()
