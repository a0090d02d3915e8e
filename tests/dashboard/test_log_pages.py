"""Pages of logs in a browser: whole on a telephone, two panels beside each other where there is room."""

import numpy as np
import pytest
from recordings import recording
from typer.testing import CliRunner

from servotwin.cli.app import app

_WIDER = (
    "[...document.querySelectorAll('*')].filter(each => each.getBoundingClientRect().right > innerWidth + 1).length"
)
_PANELS = "[...document.querySelectorAll('.panels img')].map(each => Math.round(each.getBoundingClientRect().left))"


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("log")
    made = recording(seconds=8.0, rate=100.0)
    table = np.column_stack([made.time, made.motor, made.load])
    np.savetxt(folder / "log.csv", table, delimiter=",", header="t [s],motor [rad],load [mm]", comments="")
    ran = CliRunner().invoke(app, ["identify", str(folder / "log.csv"), "--page", str(folder / "gap.html")])
    assert ran.exit_code == 0, ran.output
    return folder / "gap.html"


@pytest.mark.slow
@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize(("width", "columns"), [(360, 1), (768, 2), (1440, 2)])
def test_nothing_is_cut_off(browser, page_file, width, columns, theme):
    context = browser.new_context(viewport={"width": width, "height": 800}, color_scheme=theme)
    page = context.new_page()
    page.goto(page_file.as_uri())
    assert page.evaluate(_WIDER) == 0
    lefts = page.evaluate(_PANELS)
    assert (len(lefts), len(set(lefts))) == (4, columns)
    context.close()
