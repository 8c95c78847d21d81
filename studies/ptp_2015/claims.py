"""What Zhou & Ye 2015 claim that their own conditions do not give, said where it is shown."""

from collections.abc import Mapping

NOT_REPRODUCED: Mapping[str, str] = {
    "ptp-6": (
        "**Not reproducible as printed: 96.79 %.** The rate is reached, behind the attitude check, "
        "only if the noise of magnitude takes stars away and adds none. A star of V 6.2 that is "
        "measured half a magnitude too bright is as real to a detector as any other, stands in no "
        "guide triangle, and changes who is nearest to whom: rows *lost and added*."
    ),
    "figure-10": (
        "**Not reproducible.** Fields of 10 by 10 degrees spread evenly over the sphere hold fewer "
        "stars to V 6 than is printed, and far fewer of them hold more than eight. The printed "
        "numbers do not fit each other either: stars scattered evenly at the printed mean would "
        "leave 94 % of fields with more than eight, and real stars crowd, which leaves less."
    ),
    "figure-11": (
        "**Not reproduced.** The paper has the P-vector at about 100 % above seven stars, and PTP "
        "above it everywhere. On our fields the P-vector's two brightest neighbours leave the "
        "field at its edge whatever it holds, and of three or four stars PTP has too few "
        "triangles for two to share a star."
    ),
    "figure-12": (
        "**The ends are not reproduced.** *Strict*, PTP and the P-vector fall faster than printed "
        "(99.3 to 95.5, 98.9 to 93.7 %), the planar triangle less (99.1 to 92.1 %). The paper "
        "does not say what counts as identified, nor how wide its search is: ours widens with the "
        "noise, one misnamed star spoils a field, and behind the check PTP's loss is gone. "
        "The P-vector's ends, 98.9 and 93.7, are printed for noise of position here and once more "
        "for noise of magnitude with Figure 13: one of the two is a copy."
    ),
    "figure-13": (
        "**The ends are not reproduced**: *strict*, the P-vector falls far below 93.7 %. "
        "The P-vector's ends are those of Figure 12, printed again. It is the algorithm that "
        "depends on magnitudes, and the two noises have nothing in common."
    ),
}
