"""An S3-compatible server (moto) in a separate process, for measurements and tests on one machine."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

_SERVE = (
    "import sys, moto.server, werkzeug.serving as w;"
    "s = w.make_server('127.0.0.1', 0, moto.server.DomainDispatcherApplication("
    "moto.server.create_backend_app), threaded=True); print(s.port, flush=True); s.serve_forever()"
)


@contextmanager
def object_store(bucket: str) -> Iterator[Any]:
    """Serve an empty bucket, to which environment variables point. Needs `moto[server]` and `s3fs`."""
    import s3fs

    with subprocess.Popen(
        [sys.executable, "-c", _SERVE], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as server:
        assert server.stdout is not None
        variables = {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{int(server.stdout.readline())}"}
        variables |= {"AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing"}
        try:
            with patch.dict(os.environ, variables):
                files = s3fs.S3FileSystem(use_listings_cache=False, skip_instance_cache=True)
                files.mkdir(bucket)
                yield files
        finally:
            server.terminate()
