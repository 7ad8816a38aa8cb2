from .focus import Focus, find_focus
from .fringes import Fringes, decode_gray, fit_fringes, unwrap_frequencies, unwrap_gray
from .photometric import PhotometricStereo, photometric_stereo

__all__ = [
    "Focus",
    "Fringes",
    "PhotometricStereo",
    "decode_gray",
    "find_focus",
    "fit_fringes",
    "photometric_stereo",
    "unwrap_frequencies",
    "unwrap_gray",
]
