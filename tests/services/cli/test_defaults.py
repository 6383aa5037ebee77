"""What a command does where an option is not given is what the settings of the same name do in Python."""

from __future__ import annotations

from dataclasses import fields

import pytest

from operators.applications.live_settings import LiveSettings
from operators.applications.replay import ReplaySettings
from services.cli.options import LiveOptions, RunOptions


@pytest.mark.parametrize(("options", "settings"), [(RunOptions, ReplaySettings), (LiveOptions, LiveSettings)])
def test_options_that_are_not_given_have_the_defaults_of_the_settings(options, settings):
    stated = {field.name: field.default for field in fields(settings)}
    given = options().settings()
    assert given == {name: stated[name] for name in given}
