"""Keys for reading results over a network, with ZeroMQ's CURVE encryption.

`make_keys` makes two folders. One stays with the publisher:

    publisher/publisher.key_secret     proves that it is the publisher
    publisher/subscribers/NAME.key     who may read

the other goes to the subscriber NAME, and to nobody else:

    NAME/subscriber.key_secret         proves that it is NAME
    NAME/publisher.key                 which publisher it trusts

The files are pyzmq certificates; its authenticator checks clients (ZAP, https://rfc.zeromq.org/spec/27/).
CURVE: https://rfc.zeromq.org/spec/26/.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import zmq
import zmq.auth

if TYPE_CHECKING:
    from zmq.auth.thread import ThreadAuthenticator

DOMAIN = "tactflow"
"""The ZAP domain of all our sockets."""
HINT = "tactflow keys new makes keys"


class WrongKeysError(ValueError):
    """Keys are missing, damaged, or accessible to other users; the message states the remedy."""


def make_keys(folder: Path, name: str) -> tuple[Path, Path]:
    """Create keys for a subscriber and, if there are none, for the publisher; return the folder of each.

    folder : parent of these two folders, created if missing. name : of the subscriber: letters, digits, -
    and _.

    Raises
    ------
    WrongKeysError : the name is invalid or taken. OSError : the files cannot be written.
    """
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name) or name == "publisher":
        raise WrongKeysError(
            f"required a name of letters, digits, - and _, other than publisher, got {name!r}"
        )
    publisher, subscriber = folder / "publisher", folder / name
    if subscriber.exists():
        raise WrongKeysError(f"{subscriber} already exists; choose another name")
    mask = os.umask(0o077)
    try:
        (publisher / "subscribers").mkdir(parents=True, exist_ok=True)
        subscriber.mkdir()
        if not (publisher / "publisher.key_secret").exists():
            zmq.auth.create_certificates(publisher, "publisher")
        public, _ = zmq.auth.create_certificates(subscriber, "subscriber")
        Path(public).replace(publisher / "subscribers" / f"{name}.key")
        shutil.copy(publisher / "publisher.key", subscriber)
    finally:
        os.umask(mask)
    return publisher, subscriber


def require_keys(
    socket: zmq.Socket[bytes], context: zmq.Context[zmq.Socket[bytes]], folder: Path
) -> ThreadAuthenticator:
    """Make an unbound socket admit only the subscribers whose keys are in the publisher's folder.

    Returns the running authenticator, which the caller must stop. Raises WrongKeysError.
    """
    socket.curve_publickey, socket.curve_secretkey = _load(folder / "publisher.key_secret")
    socket.curve_server = True
    # Without these two, any client with the publisher's public key is admitted while no authenticator runs.
    socket.setsockopt(zmq.ZAP_DOMAIN, DOMAIN.encode())
    socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
    admitted = folder / "subscribers"
    files = sorted(admitted.glob("*.key"))
    if not files:
        raise WrongKeysError(f"{admitted}: there is no key of a subscriber; {HINT}")
    for file in files:
        _load(file)
    # It imports asyncio, a tenth of the start of a run.
    from zmq.auth.thread import ThreadAuthenticator

    authenticator = ThreadAuthenticator(context)
    authenticator.start()
    authenticator.configure_curve(domain=DOMAIN, location=admitted)
    return authenticator


def use_keys(socket: zmq.Socket[bytes], folder: Path) -> None:
    """Make an unconnected socket authenticate itself and its publisher. Raises WrongKeysError."""
    socket.curve_publickey, socket.curve_secretkey = _load(folder / "subscriber.key_secret")
    socket.curve_serverkey = _load(folder / "publisher.key")[0]


def _load(file: Path) -> tuple[bytes, bytes]:
    """Load the public and the secret key of a file; the latter is empty in a file of a public key.

    Refuses a key that other users can replace, change or (if it is secret) read.
    """
    is_secret = file.suffix == ".key_secret"
    try:
        for path, forbidden in ((file, 0o077 if is_secret else 0o022), (file.parent, 0o022)):
            status = path.stat()
            if sys.platform != "win32" and status.st_mode & forbidden:
                raise WrongKeysError(f"{path}: other users can read or change it; chmod go-rwx {path}")
            if sys.platform != "win32" and status.st_uid not in (0, os.geteuid()):
                raise WrongKeysError(f"{path}: belongs to another user, who can change it; chown it")
        public, secret = zmq.auth.load_certificate(file)
    except OSError as error:
        raise WrongKeysError(f"{file}: {error.strerror}; {HINT}") from None
    except ValueError as error:
        raise WrongKeysError(str(error)) from None
    # Keys of 32 bytes, as text in ZeroMQ's Z85.
    if len(public) != 40 or (is_secret and len(secret or b"") != 40):
        raise WrongKeysError(f"{file}: required keys of 40 characters; {HINT}")
    return public, secret or b""
