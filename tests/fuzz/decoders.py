"""The table of everything that reads what others have written."""

from tests.fuzz import bus_decoders, file_decoders, picture_decoders

DECODERS = (*bus_decoders.DECODERS, *file_decoders.DECODERS, *picture_decoders.DECODERS)
BY_NAME = {decoder.name: decoder for decoder in DECODERS}
