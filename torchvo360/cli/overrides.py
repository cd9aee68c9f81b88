"""What every command of ours asks of Hydra: known keys, readable values, and complaints in one sentence."""

import difflib
import re
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchvo360.checks import InputError

TYPE_ERRORS = (
    ("converted to Integer", "an integer"),
    ("converted to Float", "a number"),
    ("valid bool", "true or false"),
    ("not Optional", "a value"),
    ("is not a ListConfig", "a list such as [1,2]"),
    ("to string", "a single value"),
    ("Invalid type assigned", "its keys one by one, such as camera.fit=stretch"),
)
"""What OmegaConf says of a value that does not fit, and what was expected."""


def hydra_ready(schema: type, conf: Path, job_name: str) -> AbstractContextManager[None]:
    """Return Hydra made ready for a configuration upon a schema, or nothing where it is so already, inside a sweep."""
    ConfigStore.instance().store(name="schema", node=schema)
    if GlobalHydra.instance().is_initialized():
        return nullcontext()
    ready = hydra.initialize_config_dir(version_base="1.3", config_dir=str(conf.resolve()), job_name=job_name)
    return cast("AbstractContextManager[None]", ready)


def check_keys(overrides: Sequence[str], schema: type, groups: Sequence[str], *, example: str, printed_by: str) -> None:
    """Refuse overrides that Hydra cannot read, and keys that are not in the schema.

    Args:
        overrides: As on the command line, `key=value`.
        schema: A dataclass of settings; below a key that holds a dict anything may be named.
        groups: Keys that choose a group of settings and hold none.
        example: An override, for the message.
        printed_by: What prints all keys, for the message.

    Raises:
        InputError: There is such a one.
    """
    usual = OmegaConf.structured(schema)
    known = [*groups, *_keys(usual)]
    free = {key for key in known if key not in groups and OmegaConf.get_type(OmegaConf.select(usual, key)) is dict}
    parser = OverridesParser.create()
    for text in overrides:
        key, equal, value = text.partition("=")
        if not equal or not key or text.startswith("~"):
            raise InputError(f"{text}: expected key=value, such as {example}.")
        name = key.lstrip("+")
        anything = any(name.startswith(f"{key}.") for key in free)
        if name not in known and not anything and not name.startswith(("hydra.", "hydra/")):
            near = _nearest(name, known)
            expected = f"a known key such as {near}" if near else f"a known key ({printed_by} prints them)"
            raise InputError(f"{name}: expected {expected}, got {text}.")
        try:
            parser.parse_override(text)
        except HydraException:
            raise InputError(f"{key}: expected a value, in quotes if it has special characters, got {value}.") from None


def explained(function: Callable[..., Any], config_name: str, overrides: Sequence[str], **options: Any) -> Any:
    """Call one of Hydra's functions with a primary configuration, and turn its complaint into a sentence.

    Raises:
        InputError: Hydra refused the overrides.
    """
    try:
        return function(config_name=config_name, overrides=list(overrides), **options)
    except MissingConfigException as error:
        group, _, option = (error.missing_cfg_file or "").rpartition("/")
        raise InputError(f"{group}: expected one of {', '.join(error.options or [])}, got {option}.") from None
    except HydraException as error:
        text = str(error)
        if swept := re.match(r"(?:Ambiguous value for argument|Sweep parameters) '(.*?)=(.*)'", text):
            expected = "one value (or a list [...], or -m for a sweep)"
            raise InputError(f"{swept[1]}: expected {expected}, got {swept[2]}.") from None
        if foreign := re.match(r"Could not override '(.*?)'", text):
            raise InputError(
                f"{foreign[1]}: expected a known key, or +{foreign[1]}=... to add one, got neither."
            ) from None
        cause = str(error.__cause__ or error).partition("\n")[0].rstrip(".")
        if not (override := text.partition("Error merging override ")[2]):
            raise InputError(f"settings: expected what Hydra can compose, got its refusal: {cause}.") from None
        key, _, value = override.partition("=")
        expected = next((words for part, words in TYPE_ERRORS if part in cause), f"another value ({cause})")
        raise InputError(f"{key}: expected {expected}, got {value}.") from None


def resolved(config: DictConfig) -> Any:
    """Return the dataclasses that a composed configuration stands for.

    Raises:
        InputError: A value refers to what is not there, or a dataclass refuses it.
    """
    try:
        OmegaConf.resolve(config)
    except OmegaConfBaseException as error:
        complaint = str(error).partition("\n")[0]
        raise InputError(f"settings: expected ${{...}} to name a known key, got: {complaint}.") from None
    return _to_dataclass(config)


def to_yaml(config: object) -> str:
    """Return settings as YAML."""
    return OmegaConf.to_yaml(OmegaConf.structured(config))


def quoted(value: str) -> str:
    """Return a value as Hydra's grammar quotes it: backslashes count only before a quote."""
    return "'" + re.sub(r"\\+(?='|$)", r"\g<0>\g<0>", value).replace("'", r"\'") + "'"


def literal(override: str) -> str:
    """Quote the value of an override whose value is to be taken as it stands, unless it is quoted already."""
    key, _, value = override.partition("=")
    return f"{key}={quoted(value)}" if value not in ("", "null") and value[0] not in "'\"" else override


def _to_dataclass(node: DictConfig, path: str = "") -> Any:
    """Make the dataclasses, the innermost first, so that what one refuses is told with the key's full name."""
    for key, child in node.items():
        if isinstance(child, DictConfig):
            _to_dataclass(child, f"{path}{key}.")
    try:
        return OmegaConf.to_object(node)
    except InputError as error:
        raise InputError(f"{path}{error}") from None


def _keys(node: DictConfig, path: str = "") -> list[str]:
    keys = []
    for key, child in node.items():
        keys += [f"{path}{key}", *(_keys(child, f"{path}{key}.") if isinstance(child, DictConfig) else [])]
    return keys


def _nearest(name: str, known: Sequence[str]) -> str | None:
    """Return the known key most like a name, by its full name or else by its last part."""
    if near := difflib.get_close_matches(name, known, n=1):
        return near[0]
    by_last_part = {key.rpartition(".")[2]: key for key in known}
    near = difflib.get_close_matches(name.rpartition(".")[2], by_last_part, n=1)
    return by_last_part[near[0]] if near else None
