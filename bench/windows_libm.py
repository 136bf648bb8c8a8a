"""Makes a ucrtbase.dll for Wine 10 that has C99's complex functions, which numpy needs; Wine's own has all others.

usage: windows_libm.py UCRTBASE_DLL SYSTEM32    (needs x86_64-w64-mingw32-gcc)
"""

import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

COMPLEX = [
    "cacos",
    "cacosh",
    "casin",
    "casinh",
    "catan",
    "catanh",
    "ccos",
    "ccosh",
    "cexp",
    "clog",
    "conj",
    "cproj",
    "csin",
    "csinh",
    "csqrt",
    "ctan",
    "ctanh",
]
REAL = ["cabs", "carg", "cimag", "creal"]
BEGIN = """
#include <complex.h>
typedef struct {double r, i;} D; typedef struct {float r, i;} F;
static double complex d(D a) {double complex z; __real__ z = a.r; __imag__ z = a.i; return z;}
static double complex f(F a) {double complex z; __real__ z = a.r; __imag__ z = a.i; return z;}
static D fromd(double complex z) {D a = {__real__ z, __imag__ z}; return a;}
static F fromf(double complex z) {F a = {(float)__real__ z, (float)__imag__ z}; return a;}
int __stdcall DllMainCRTStartup(void *a, unsigned b, void *c) {return 1;}
D x_clog10(D a) {return fromd(clog(d(a)) / 2.302585092994045684);}
F x_clog10f(F a) {return fromf(clog(f(a)) / 2.302585092994045684);}
D x_cpow(D a, D b) {return fromd(cpow(d(a), d(b)));}
F x_cpowf(F a, F b) {return fromf(cpow(f(a), f(b)));}
double x_norm(D a) {return a.r * a.r + a.i * a.i;}
float x_normf(F a) {return a.r * a.r + a.i * a.i;}
D x__Cbuild(double r, double i) {D a = {r, i}; return a;}
F x__FCbuild(float r, float i) {F a = {r, i}; return a;}
D x__Cmulcc(D a, D b) {D c = {a.r * b.r - a.i * b.i, a.r * b.i + a.i * b.r}; return c;}
F x__FCmulcc(F a, F b) {F c = {a.r * b.r - a.i * b.i, a.r * b.i + a.i * b.r}; return c;}
D x__Cmulcr(D a, double b) {D c = {a.r * b, a.i * b}; return c;}
F x__FCmulcr(F a, float b) {F c = {a.r * b, a.i * b}; return c;}
"""
"""`long double` is `double` on Windows, so that those functions are the same."""


def exported_names(data: bytes) -> Iterator[str]:
    """Yield the names that a library exports (PE format, section `.edata`)."""
    pe = struct.unpack_from("<I", data, 0x3C)[0]
    sections, optional = struct.unpack_from("<H", data, pe + 6)[0], struct.unpack_from("<H", data, pe + 20)[0]
    table = [struct.unpack_from("<8sIIII", data, pe + 24 + optional + 40 * at) for at in range(sections)]

    def offset(rva: int) -> int:
        return next(raw + rva - start for _, size, start, rest, raw in table if start <= rva < start + max(size, rest))

    directory = offset(struct.unpack_from("<I", data, pe + 24 + 112)[0])
    count, names = struct.unpack_from("<I", data, directory + 24)[0], struct.unpack_from("<I", data, directory + 32)[0]
    for at in range(count):
        begin = offset(struct.unpack_from("<I", data, offset(names) + 4 * at)[0])
        yield data[begin : data.index(b"\0", begin)].decode()


def main(ucrtbase: Path, system32: Path) -> None:
    """Compile the library; Wine's own is left beside it under another name, and everything else forwarded to it."""
    image = ucrtbase.read_bytes()
    code = [BEGIN]
    for name in COMPLEX:
        code += [
            f"D x_{name}(D a) {{return fromd({name}(d(a)));}}",
            f"F x_{name}f(F a) {{return fromf({name}(f(a)));}}",
        ]
    for name in REAL:
        code += [f"double x_{name}(D a) {{return {name}(d(a));}}", f"float x_{name}f(F a) {{return {name}(f(a));}}"]
    mine = {}
    for name in [*COMPLEX, *REAL, "clog10", "cpow", "norm"]:
        mine |= {name: f"x_{name}", f"{name}l": f"x_{name}", f"{name}f": f"x_{name}f"}
    for name in ("build", "mulcc", "mulcr"):
        mine |= {f"_C{name}": f"x__C{name}", f"_LC{name}": f"x__C{name}", f"_FC{name}": f"x__FC{name}"}
    with tempfile.TemporaryDirectory() as folder:
        source, exports, library = (Path(folder) / name for name in ("c.c", "u.def", "ucrtbase.dll"))
        source.write_text("\n".join(code) + "\n", "utf-8")
        lines = [f'"{name}"={mine.get(name, f"ucrtwine.{name}")}' for name in exported_names(image)]
        exports.write_text("\n".join(["LIBRARY ucrtbase.dll", "EXPORTS", *lines, ""]), "utf-8")
        flags = ["-O1", "-w", "-fno-builtin", "-shared", "-nostartfiles", "-Wl,--entry,DllMainCRTStartup"]
        libraries = ["-lmingwex", "-lmsvcrt", "-lgcc"]
        subprocess.run(["x86_64-w64-mingw32-gcc", *flags, "-o", library, source, exports, *libraries], check=True)
        system32.joinpath("ucrtbase.dll").unlink(missing_ok=True)
        system32.joinpath("ucrtbase.dll").write_bytes(library.read_bytes())
    # Without Wine's mark it is loaded from there, under its new name.
    system32.joinpath("ucrtwine.dll").write_bytes(image.replace(b"Wine builtin DLL", b"Wine copied DLL\0", 1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
