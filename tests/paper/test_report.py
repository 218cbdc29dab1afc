import pytest

from paper.report import PAPER, READMES, filled, results


@pytest.mark.parametrize("path", READMES, ids=["README.md", "paper/README.md"])
def test_readmes_show_the_committed_results(path):
    text = path.read_text()
    assert filled(text, results(PAPER / "results")) == text


def test_fragments_replace_what_stands_between_their_markers():
    text = "a\n<!-- x -->\nold\n<!-- end -->\nb"
    assert filled(text, {"x": "new"}) == "a\n<!-- x -->\nnew\n<!-- end -->\nb"


def test_unknown_marker_is_an_error():
    with pytest.raises(ValueError, match="No result is called 'y'"):
        filled("<!-- y -->\n<!-- end -->", {"x": "new"})
