from kfgs.viz.explorer.query_line import LONGEST, QueryLine

NAMES = ("wall", "Chair", "chandelier", "table")


def typed(line, text):
    for character in text:
        assert line.press(character, character) == "typing"


def test_letters_spaces_and_backspace():
    line = QueryLine(NAMES)
    typed(line, "red chairz")
    line.press("BackSpace", "\b")
    assert line.text == "red chair"
    for _ in range(20):
        line.press("BackSpace", "\b")
    assert line.text == ""


def test_keys_that_type_nothing_change_nothing():
    line = QueryLine(NAMES)
    typed(line, "ab")
    for key, character in (("Shift_L", ""), ("F5", ""), ("Left", "\x00"), ("Delete", "\x7f")):
        assert line.press(key, character) == "typing"
    assert line.text == "ab"


def test_enter_asks_and_escape_drops():
    line = QueryLine(NAMES)
    typed(line, "q")
    assert line.press("Return", "\r") == "ask"
    assert line.press("KP_Enter", "\r") == "ask"
    assert line.press("Escape", "\x1b") == "drop"
    assert line.text == "q"


def test_tab_goes_round_the_classes_that_begin_like_this():
    line = QueryLine(NAMES)
    typed(line, "ch")
    assert line.hint == "air"
    seen = []
    for _ in range(3):
        line.press("Tab", "\t")
        seen.append(line.text)
    assert seen == ["Chair", "chandelier", "Chair"]
    line.press("ISO_Left_Tab", "")
    assert line.text == "chandelier"
    typed(line, "s")
    line.press("Tab", "\t")
    assert line.text == "chandeliers"  # no class begins like this: nothing happens


def test_backward_tab_begins_with_the_last():
    line = QueryLine(NAMES)
    typed(line, "c")
    line.press("ISO_Left_Tab", "")
    assert line.text == "chandelier"


def test_nothing_is_hinted_before_a_letter():
    assert QueryLine(NAMES).hint == ""


def test_the_line_has_an_end():
    line = QueryLine(NAMES)
    typed(line, "x" * (LONGEST + 5))
    assert line.text == "x" * LONGEST
