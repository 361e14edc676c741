"""Program that expands one xacro document in an isolated process that does not import fflin.

The program's arguments are the path of the document, the time limit [s], the xacro arguments as a
JSON object, and the entries of `sys.path`. Until the program has set `sys.path`, it imports only
built-in modules.
"""

import sys


def main(path: str, limit: float, arguments: str) -> None:
    """Expand a document from stdin; write one line of JSON, then the URDF.

    The line contains the paths of the included files, and the names of the declared arguments.
    """
    import contextlib
    import faulthandler
    import json
    import re
    from pathlib import Path

    # End this process at the time limit, even if the parent process has ended.
    faulthandler.dump_traceback_later(limit, exit=True)
    import xacro
    from xacrodoc import XacroDoc, packages

    document = sys.stdin.buffer.read().decode("utf-8-sig")
    try:
        with contextlib.redirect_stdout(sys.stderr):
            packages.walk_up_from(path)
            # xacro searches for included files relative to the file on top of its stack.
            xacro.init_stacks(path)
            urdf = XacroDoc.from_string(
                document,
                subargs=json.loads(arguments),
                resolve_packages=False,
                rootdir=Path(path).parent,
            ).to_urdf_string()
    except (
        Exception
    ) as error:  # xacro evaluates Python expressions, which may raise anything
        sys.exit(" ".join(str(error).split()) or type(error).__name__)
    # The list contains all included documents and YAML files, without repetition.
    files = sorted(set(xacro.all_includes))
    texts = [document, *(Path(file).read_text(errors="replace") for file in files)]
    declared = re.findall(
        r"""<xacro:arg\s[^>]*?name\s*=\s*["']([^"']*)""", " ".join(texts)
    )
    head = json.dumps({"files": files, "arguments": sorted(set(declared))})
    sys.stdout.buffer.write(f"{head}\n{urdf}".encode())


if __name__ == "__main__":
    sys.path[:] = sys.argv[4:]
    main(sys.argv[1], float(sys.argv[2]), sys.argv[3])
