"""Files of tensors (safetensors) that come into being as all other files of this project do.

safetensors writes a temporary file that its owner alone may read, and tells in words which error of the system it met.
"""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from femoreg_torch.files import temporary_file

_NUMBER = re.compile(r"\(os error (\d+)\)")
_FOR_ALL = 0o666  # what a new file may be, before the umask takes from it


@contextmanager
def tensor_file(path: Path) -> Iterator[Path]:
    """As `femoreg_torch.files.temporary_file`, for a block that lets safetensors write.

    The file may be read by whom the umask lets read. An `OSError` of the block names `path` and the system's reason.
    """
    with temporary_file(path) as part:
        try:
            yield part
        except OSError as error:
            number = _NUMBER.search(str(error))
            if error.errno is None and number is not None:
                raise OSError(int(number[1]), os.strerror(int(number[1])), str(path)) from error
            raise
        part.chmod(part.parent.stat().st_mode & _FOR_ALL)  # the umask has seen the folder that it was written in
