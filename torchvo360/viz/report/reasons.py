"""What the odometry's reasons mean, in a few words for a person; the words of docs/usage.md."""

MEANINGS = {
    "ok": "found by alignment with the map's points",
    "first_frame": "the search for a start has just begun",
    "few_tracks": "too few of the corners are left to start from",
    "low_parallax": "the camera has hardly moved yet",
    "few_inliers": "the corners agree on no motion",
    "low_cheirality": "the corners' points lie behind the camera",
    "refinement_failed": "the joint refinement of the start did not hold",
    "few_ranges": "the rig's images of this moment show too few ranges",
    "stereo_ranges": "the rig's images made the map",
    "sensor_ranges": "the sensor's ranges made the map",
    "learned_ranges": "the network's ranges made the map",
    "start_settled": "a start from parallax took over from the network's ranges",
    "start_corrected": "a better start replaced the first one",
    "low_agreement": "tracked, but little of the gradient agrees",
    "no_agreement": "neither the map nor any keyframe tried shows this frame",
    "restarting": "from here on a new map is looked for",
    "present_keyframe": "found again where it was lost",
    "earlier_keyframe": "found at another keyframe",
    "new_map": "a new map begins",
    "maps_joined": "a place of an earlier map was seen, and the two are one from now on",
    "bad_frame_unreadable": "the image could not be read",
    "bad_frame_size": "the image has another size",
    "bad_frame_black": "the image is black",
    "bad_frame_white": "the image is white",
    "bad_frame_nan": "the image holds values that are no numbers",
}


def meaning(reason: str) -> str:
    """Return the sentence of a reason, empty for one that is not known."""
    return MEANINGS.get(reason, "")
