"""Addresses of stores as they may be shown, and the way to servers of this machine. Imports nothing heavy."""

import json
import os
import re
from collections.abc import Iterator, MutableMapping
from urllib.parse import quote, quote_plus, unquote, unquote_plus, urlsplit

HIDDEN = "***"
ADDRESSES = ("MLFLOW_TRACKING_URI", "MLFLOW_REGISTRY_URI", "OPTUNA_STORAGE")  # that may have a password in them
SECRETS = ("MLFLOW_TRACKING_PASSWORD", "MLFLOW_TRACKING_TOKEN", "PGPASSWORD", "RAY_AUTH_TOKEN")  # that are one
TELLING = re.compile(r"pass|pwd|secret|token|key|cred|signature|odbc_connect", re.IGNORECASE)  # names of such values
SHORT = 4  # characters: what is shorter would be found inside other words, and is hidden where it stands in an address
USER = re.compile(r"(\w[\w+.-]*://[^\s/:@'\"]*):[^\s@]+@")  # up to the password of any address in a text
VALUE = re.compile(r"\b(\w*(?:passw|pwd|secret|token)\w*=)[^\s&;'\"]+", re.IGNORECASE)  # of a query in a text
LOOPBACK = ("localhost", "127.0.0.1", "::1", "[::1]")  # urllib compares an address of IPv6 with its brackets
NOT_PROXIES = {"no_proxy", "git_proxy"}


def without_password(address: str) -> str:
    """An address as it may be shown; where it is not clear what in it is the password, its kind alone."""
    kind, mark, rest = address.partition("://")
    if not mark:
        return HIDDEN if "@" in address or TELLING.search(address) else address
    body, asked, query = rest.partition("?")
    place, slash, path = body.partition("/")
    if unclear(address):
        return f"{kind}://{HIDDEN}"
    user, at, host = place.rpartition("@")
    name, colon, _ = user.partition(":")
    shown = f"{name}{colon}{HIDDEN if colon else ''}{at}{host}"
    return f"{kind}://{shown}{slash}{path}{asked}{_shown_query(query)}"


def unclear(address: str) -> bool:
    """True if a user name or password holds characters that end it, so that programs would read it differently."""
    kind, _, rest = address.partition("://")
    place = re.split(r"[/?#]", rest, maxsplit=1)[0]
    return not kind.startswith("sqlite") and ("@" in rest[len(place) :] or "#" in rest or place.count("@") > 1)


def fault(variable: str, address: str) -> str:
    """The reason why an address cannot be used, for a person; nothing if it is clear what in it is what."""
    shown = f"{variable}={without_password(address)}: not an address that can be read"
    if unclear(address):
        return f"{shown}; in its name and password write @ as %40, / as %2F, ? as %3F and # as %23"
    try:
        return "" if urlsplit(address).port != 0 else f"{shown}; its port is 0"
    except ValueError:
        return f"{shown}; after the host, if anything, comes a port from 1 to 65535, as in http://HOST:5000"


def _shown_query(query: str) -> str:
    """The parameters without the values that may be secret."""
    parts = (part.partition("=") for part in re.split("([&;])", query))
    return "".join(f"{key}={HIDDEN}" if mark and _telling(key) else f"{key}{mark}{value}" for key, mark, value in parts)


def _telling(key: str) -> bool:
    return TELLING.search(unquote_plus(key)) is not None


def scrubbed(text: str) -> str:
    """A text for people or files, without the passwords of the addresses that the environment names.

    They are hidden as they were typed, decoded, and as libraries write them.
    """
    for name in ADDRESSES:
        if address := os.environ.get(name):
            text = text.replace(address, without_password(address))
    for secret in sorted(set(_secrets()), key=len, reverse=True):
        plain = re.escape(secret)  # a word is hidden where it is one: `mlflow` is a password too, and part of names
        text = re.sub(rf"(?<!\w){plain}(?!\w)" if secret.isalnum() else plain, HIDDEN, text)
    return VALUE.sub(rf"\1{HIDDEN}", USER.sub(rf"\1:{HIDDEN}@", text))


def _secrets() -> Iterator[str]:
    found = [os.environ.get(name, "") for name in SECRETS]
    for name in ADDRESSES:
        found += _passwords(os.environ.get(name, ""))
    for secret in found:
        yield from (form for form in _forms(secret) if len(form) >= SHORT)


def _passwords(address: str) -> Iterator[str]:
    """The parts that may be secret in an address, as it is written there."""
    kind, _, rest = address.partition("://")
    if not kind.startswith("sqlite"):
        password = rest.rpartition("@")[0].partition(":")[2]
        yield password
        if unclear(address):  # libraries then speak of parts of it
            yield from re.split("[/?#@:]", password)
    for key, _, value in (part.partition("=") for part in re.split("[?&;]", rest)):
        if _telling(key):
            yield value


def _forms(secret: str) -> Iterator[str]:
    """A secret as it may be written."""
    yield from (secret, secret.replace("%", "%%"))
    for word in (unquote(secret), unquote_plus(secret)):
        yield from (word, quote(word, safe=""), quote(word), quote(word, safe=" +"), quote_plus(word))
        yield from (repr(word)[1:-1], json.dumps(word)[1:-1])


def reach_loopback(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let requests to this machine pass by the proxies that a person has set, for this process and all it starts.

    Without a proxy nothing is set: a `no_proxy` alone would make Python overlook the proxies of the system.
    """
    names = {name.lower() for name, value in environment.items() if value}
    if not any(name.endswith("_proxy") for name in names - NOT_PROXIES):
        return
    given = environment.get("no_proxy") or environment.get("NO_PROXY") or ""
    there = [word.strip() for word in given.split(",") if word.strip()]
    if "*" not in there:
        environment["no_proxy"] = environment["NO_PROXY"] = ",".join(dict.fromkeys([*there, *LOOPBACK]))
