"""What commands say besides what was asked for."""

import pytest

from mirrorskin.cli.output import print_fields, report_missing_maps


@pytest.mark.parametrize(
    ("process", "said"),
    [
        (
            {"height": "none: the recording has no pixel size"},
            "a.h5: no height: the recording has no pixel size; give it",
        ),
        ({"height": "made"}, ""),
        ({"gel": "none: the calibration has no gel"}, ""),
        (
            {"gel": "none: nothing turned light"},
            "a.h5: heights not corrected for the gel: nothing turned light",
        ),
        (
            {"gel": "corrected for the gel; 3 pixels more"},
            "a.h5: heights corrected for the gel; 3 pixels more",
        ),
    ],
)
def test_what_is_missing_and_what_a_gel_did_is_told_in_a_line(process, said, capsys):
    report_missing_maps("a.h5", process, {"height": "it"})
    assert capsys.readouterr() == ("", f"{said}\n" if said else "")


def test_no_text_of_a_file_steers_the_terminal_or_forges_a_line(capsys):
    print_fields({"title": "a\x1b[2J\x07b\nkind  result\u202e"})
    assert capsys.readouterr().out == "title  a?[2J?b?kind  result?\n"
