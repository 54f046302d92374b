# SPDX-License-Identifier: Apache-2.0
"""Whether a command's results can be put where the user wants them, found out before the work."""

import os

from .errors import SceneError


def check_output(path, suffix=None, inputs=()):
    """SceneError when a file cannot be written at `path`: no such folder, a folder of that name, no right to
    write, a name that does not end in `suffix` (".npz"), or one of the files that the command reads.
    """
    folder, name = os.path.dirname(path) or ".", os.path.basename(path)
    if not os.path.isdir(folder):
        raise SceneError("there is no folder %s to write %s into" % (folder, name), "create it first")
    if suffix and os.path.splitext(name)[1].lower() != suffix:
        raise SceneError("%s does not end in %s" % (path, suffix), "call it, for example, map" + suffix)
    for read in filter(None, inputs):
        if os.path.exists(path) and os.path.exists(read) and os.path.samefile(path, read):
            raise SceneError("%s is what the command reads" % path, "write to another file")
    if os.path.isdir(path) or not os.access(folder, os.W_OK):
        raise SceneError("%s cannot be written" % path, "choose another place")
