"""Keys of publishers and subscribers: who may read results over a network, encrypted by ZeroMQ's CURVE.

`make_keys` makes two folders. One stays with the publisher:

    publisher/publisher.key_secret     what it proves to be itself with
    publisher/subscribers/NAME.key     who may read

the other goes to the subscriber NAME, and to nobody else:

    NAME/subscriber.key_secret         what it proves to be NAME with
    NAME/publisher.key                 whom it takes for the publisher

The files are certificates as ZeroMQ's own tools write them. CURVE (https://rfc.zeromq.org/spec/26/) and the
check of who asks (https://rfc.zeromq.org/spec/27/) are those of libzmq and pyzmq.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import sys
from pathlib import Path

import zmq
import zmq.auth

PUBLISHER, SUBSCRIBER = "publisher", "subscriber"
"""Names of key files, without their endings; the first also of the publisher's folder."""
SUBSCRIBERS = "subscribers"
"""The publisher's folder of public keys."""
KEY_LETTERS = 40
"""Length of a key, as text in ZeroMQ's Z85."""
DOMAIN = "tactflow"
"""What an authenticator is asked about (`ZAP`): who may read results."""
HINT = "tactflow keys new makes keys"


class WrongKeysError(ValueError):
    """Keys are missing, damaged, or readable by others; says what to do."""


def make_keys(folder: Path, name: str) -> tuple[Path, Path]:
    """Make keys for one subscriber, and for the publisher unless it has some.

    folder : gets a folder for each of the two; made if it is not there. name : of the subscriber: letters,
    digits, - and _.

    Returns
    -------
    The publisher's folder, and the subscriber's.

    Raises
    ------
    WrongKeysError : the name is no name or taken. OSError : the files cannot be written.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as made:
    ...     publisher, laptop = make_keys(Path(made, "keys"), "laptop")
    ...     sorted(path.name for path in laptop.iterdir())
    ['publisher.key', 'subscriber.key_secret']
    """
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name) or name == PUBLISHER:
        raise WrongKeysError(
            f"required a name of letters, digits, - and _, other than publisher, got {name!r}"
        )
    publisher, subscriber = folder / PUBLISHER, folder / name
    allowed = publisher / SUBSCRIBERS
    if subscriber.exists():
        raise WrongKeysError(f"{subscriber} is there already; choose another name")
    for private in (folder, publisher, allowed, subscriber):
        private.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not (publisher / f"{PUBLISHER}.key_secret").exists():
        _certificate(publisher, PUBLISHER)
    _certificate(subscriber, SUBSCRIBER)
    (subscriber / f"{SUBSCRIBER}.key").replace(allowed / f"{name}.key")
    shutil.copy(publisher / f"{PUBLISHER}.key", subscriber)
    return publisher, subscriber


def _certificate(folder: Path, name: str) -> None:
    """Two files with new keys; of the secret one, only the owner can read a word."""
    secret = folder / f"{name}.key_secret"
    # pyzmq would make it readable for others.
    os.close(os.open(secret, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    public, _ = zmq.auth.create_certificates(folder, name)
    os.chmod(public, 0o600)


def secure_publisher(socket: zmq.Socket[bytes], folder: Path) -> None:
    """Let a socket that is not bound yet admit only subscribers that prove who they are.

    Nobody is admitted before an authenticator of the socket's context says so (`subscribers_folder`).

    Raises
    ------
    WrongKeysError : the folder has no keys of a publisher.
    """
    public, secret = _read(folder / f"{PUBLISHER}.key_secret")
    socket.curve_publickey, socket.curve_secretkey = public, secret
    socket.curve_server = True
    # Without these two, whoever has the publisher's public key is admitted while nobody answers for it.
    socket.setsockopt(zmq.ZAP_DOMAIN, DOMAIN.encode())
    socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)


def subscribers_folder(folder: Path) -> Path:
    """The publisher's folder with the keys of who may read.

    Raises
    ------
    WrongKeysError : it has none, or one is damaged.
    """
    allowed = folder / SUBSCRIBERS
    files = sorted(allowed.glob("*.key"))
    if not files:
        raise WrongKeysError(f"{allowed}: there is no key of a subscriber; {HINT}")
    for file in files:
        _read(file)
    return allowed


def secure_subscriber(socket: zmq.Socket[bytes], folder: Path) -> None:
    """Let a socket that is not connected yet prove who it is, and listen to the right publisher alone.

    Raises
    ------
    WrongKeysError : the folder has no keys of a subscriber.
    """
    public, secret = _read(folder / f"{SUBSCRIBER}.key_secret")
    socket.curve_publickey, socket.curve_secretkey = public, secret
    socket.curve_serverkey = _read(folder / f"{PUBLISHER}.key")[0]


def _refuse_open_to_others(file: Path, *, is_secret: bool) -> None:
    """Whoever may write into the folder, or to a key in it, lets in whom he wants."""
    if sys.platform == "win32":
        return
    if is_secret and stat.S_IMODE(file.stat().st_mode) & 0o077:
        raise WrongKeysError(f"{file}: others may read it; chmod 600 {file}")
    for place in (file.parent, file):
        if stat.S_IMODE(place.stat().st_mode) & 0o022:
            raise WrongKeysError(f"{place}: others may write to it; chmod go-w {place}")


def _read(file: Path) -> tuple[bytes, bytes]:
    """The public and the secret key in a file; the latter is empty in one of a public key."""
    is_secret = file.suffix == ".key_secret"
    try:
        _refuse_open_to_others(file, is_secret=is_secret)
        public, secret = zmq.auth.load_certificate(file)
    except WrongKeysError:
        raise
    except (OSError, ValueError) as error:
        reason = "there is no such file" if not file.exists() else str(error)
        raise WrongKeysError(f"{file}: {reason}; {HINT}") from None
    if len(public) != KEY_LETTERS or (is_secret and len(secret or b"") != KEY_LETTERS):
        raise WrongKeysError(f"{file}: required keys of {KEY_LETTERS} letters; {HINT}")
    return public, secret or b""
