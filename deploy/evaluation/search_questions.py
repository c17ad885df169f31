"""Questions in plain words with known answers, about two homes with ground truth.

They were written, and committed, before anything that answers them was tuned. Constants of the search are chosen on
those with odd numbers; those with even numbers are left out, and judge. The last of each home have no answer there.
"""

from typing import NamedTuple


class TextQuestion(NamedTuple):
    """A text, and the true regions and objects, by label, any of which answers it; none = nothing there does."""

    number: int
    text: str
    regions: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()

    @property
    def left_out(self) -> bool:
        """Whether nothing may be chosen on it."""
        return self.number % 2 == 0


QUESTIONS: dict[str, tuple[TextQuestion, ...]] = {  # by name of the sequence
    "aws_small_house": (
        TextQuestion(1, "somewhere to sit and eat", ("dining area",), ("dining table",)),
        TextQuestion(2, "a place to sleep", ("bedroom",), ("bed",)),
        TextQuestion(3, "where can I cook dinner?", ("kitchen",), ("stove",)),
        TextQuestion(4, "watch a film on the sofa", ("living room",), ("sofa",)),
        TextQuestion(5, "lift weights", ("home gym",), ("barbell", "weight bench")),
        TextQuestion(6, "take my shoes off when I come home", ("entrance",), ("shoe rack",)),
        TextQuestion(7, "sunbathe behind big windows", ("sun lounge",)),
        TextQuestion(8, "read a book in silence", ("quiet area",)),
        TextQuestion(9, "where is the fridge?", ("kitchen",), ("refrigerator",)),
        TextQuestion(10, "something is burning on the stove", ("kitchen",), ("stove",)),
        TextQuestion(11, "hang up my coat", ("entrance",), ("wardrobe",)),
        TextQuestion(12, "have breakfast with four people", ("dining area",), ("dining table",)),
        TextQuestion(13, "do my morning exercises", ("home gym",)),
        TextQuestion(14, "the television", ("living room",), ("television",)),
        TextQuestion(15, "put clean clothes away", ("bedroom",), ("wardrobe",)),
        TextQuestion(16, "lie down for a nap after lunch", ("bedroom", "living room"), ("bed", "sofa")),
        TextQuestion(17, "welcome visitors at the front door", ("entrance",), ("door",)),
        TextQuestion(18, "sit with friends around a coffee table", ("living room",), ("coffee table",)),
        TextQuestion(19, "study undisturbed", ("quiet area",), ("desk",)),
        TextQuestion(20, "a bright spot with chairs to enjoy the sun", ("sun lounge",)),
        TextQuestion(41, "refuel the car"),
        TextQuestion(42, "buy a train ticket"),
        TextQuestion(43, "patients wait here for the doctor"),
    ),
    "home": (
        TextQuestion(21, "take a shower", ("bathroom",)),
        TextQuestion(22, "somewhere to sit and eat", ("dining room",)),
        TextQuestion(23, "boil water for tea", ("kitchen",)),
        TextQuestion(24, "go to bed", ("bedroom",)),
        TextQuestion(25, "the toilet", ("bathroom",)),
        TextQuestion(26, "guests want to sit comfortably and talk", ("living room",)),
        TextQuestion(27, "brush my teeth", ("bathroom",)),
        TextQuestion(28, "put the milk back into the fridge", ("kitchen",)),
        TextQuestion(29, "a long table with chairs around it", ("dining room",)),
        TextQuestion(30, "get dressed in the morning", ("bedroom",)),
        TextQuestion(31, "watch the news in the evening", ("living room",)),
        TextQuestion(32, "bake a cake", ("kitchen",)),
        TextQuestion(33, "where are the towels?", ("bathroom",)),
        TextQuestion(34, "tuck the children in", ("bedroom",)),
        TextQuestion(35, "relax on the couch", ("living room",)),
        TextQuestion(36, "family dinner on Sunday", ("dining room",)),
        TextQuestion(37, "wash the dishes", ("kitchen",)),
        TextQuestion(38, "change the sheets and pillows", ("bedroom",)),
        TextQuestion(39, "lay the table for six guests", ("dining room",)),
        TextQuestion(40, "have a bath with candles", ("bathroom",)),
        TextQuestion(44, "land a helicopter"),
        TextQuestion(45, "pay for the groceries"),
        TextQuestion(46, "feed the elephants"),
    ),
}
