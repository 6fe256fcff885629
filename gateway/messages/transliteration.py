"""ASCII letters for texts of the languages that use Latin, Greek and Cyrillic letters."""

import unicodedata
from typing import Final

_PAIRS: Final = """
ß ss  æ ae  œ oe  ø o  ł l  đ d  ð d  þ th  ħ h  ŧ t  ŋ ng  ı i  ĸ k  ə e
α a  β b  γ g  δ d  ε e  ζ z  η i  θ th  ι i  κ k  λ l  μ m  ν n  ξ x  ο o  π p  ρ r  σ s  ς s  τ t  υ y
φ f  χ ch  ψ ps  ω o
а a  б b  в v  г g  ґ g  д d  ђ dj  е e  є ie  ж zh  з z  и i  і i  ј j  к k  л l  љ lj  м m  н n  њ nj
о o  п p  р r  с s  т t  ћ c  у u  ф f  х kh  ц ts  ч ch  џ dz  ш sh  щ shch  ъ y  ы y  ь _  э e  ю iu  я ia
"""
_SMALL: Final = dict(zip(_PAIRS.split()[::2], _PAIRS.split()[1::2], strict=True))
_LETTERS: Final = str.maketrans(
    {letter: ascii_.replace("_", "") for letter, ascii_ in _SMALL.items()}
    | {
        letter.upper(): ascii_.replace("_", "").capitalize()
        for letter, ascii_ in _SMALL.items()
        if len(letter.upper()) == 1
    }
    | {"ẞ": "SS", "I": "I"}  # the capital of ı is that of i
)


def without_accents(text: str) -> str:
    """Return ``text`` without accents, and with ASCII letters for others: "é ß ø" becomes "e ss o".

    Letters of further scripts, such as Chinese ones, stay.
    """
    plain = "".join(each for each in unicodedata.normalize("NFKD", text) if not unicodedata.combining(each))
    return plain.translate(_LETTERS)
