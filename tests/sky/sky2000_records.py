"""SKY2000 records as the catalog's published description of their bytes has them."""

# Of the description (CDS V/109): first and last byte, Fortran format, label.  All that it gives.
PUBLISHED = """
1-7 A7 designation|9-27 A19 SKY2000|28-35 I8 ID|36-41 I6 HD|42-42 A1 m_HD|43-43 A1 u_HD|44-49 I6 SAO
50-50 A1 m_SAO|51-61 A11 DM|62-62 A1 m_DM|63-63 A1 u_DM|64-67 I4 HR|68-77 A10 WDS|78-82 A5 m_WDS
83-83 A1 u_WDS|84-89 I6 PPM|90-90 A1 u_PPM|91-98 I8 ID_merg|99-108 A10 Name|109-118 A10 Vname
119-120 I2 RAh|121-122 I2 RAm|123-129 F7.4 RAs|130-130 A1 DE-|131-132 I2 DEd|133-134 I2 DEm
135-140 F6.3 DEs|141-146 F6.4 e_pos|147-147 A1 f_pos|148-149 I2 r_pos|150-157 F8.5 pmRA
158-165 F8.4 pmDE|166-167 I2 r_pm|168-173 F6.1 RV|174-175 I2 r_RV|176-183 F8.5 Plx
184-191 F8.6 e_Plx|192-193 I2 r_Plx|194-202 F9.6 GCI_X|203-211 F9.6 GCI_Y|212-220 F9.6 GCI_Z
221-226 F6.2 GLON
227-232 F6.2 GLAT|233-238 F6.3 Vmag|239-243 F5.2 Vder|244-248 F5.3 e_Vmag|249-249 A1 f_Vmag
250-251 I2 r_Vmag|252-252 I1 n_Vmag|253-258 F6.3 Bmag|259-264 F6.3 B-V|265-269 F5.3 e_Bmag
270-270 A1 f_Bmag|271-272 I2 r_Bmag|342-348 F7.3 sep|349-353 F5.2 Dmag|374-380 F7.4 dist1
381-387 F7.4 dist2|388-395 I8 ID_A|396-403 I8 ID_B|404-411 I8 ID_C|422-426 F5.2 varAmp
"""
LAYOUT = {
    label: (int(span.split("-")[0]), int(span.split("-")[1]), form)
    for part in PUBLISHED.replace("\n", "|").split("|")
    if part
    for span, form, label in [part.split()]
}


def written(**values):
    """A record of 520 bytes: each value in its bytes, in the published Fortran format."""
    record = [" "] * 520
    for label, value in ({"designation": "SKY2000"} | values).items():
        if value is None:
            continue
        first, last, form = LAYOUT[label]
        width = last - first + 1
        if form[0] == "A":
            text = str(value).ljust(width)
        elif form[0] == "I":
            text = f"{value:{width}d}"
        else:
            text = f"{value:{width}.{form.split('.')[1]}f}"
            # Fortran leaves the zero before the point out where it has no room for it.
            text = text.replace("0.", ".", 1) if len(text) > width else text
        assert len(text) == width, (label, value)
        record[first - 1 : last] = text
    return "".join(record)


SIRIUS = {
    "SKY2000": "J064508.92-164258.0",
    "ID": 6450085,
    "HD": 48915,
    "SAO": 151881,
    "HR": 2491,
    "RAh": 6,
    "RAm": 45,
    "RAs": 8.9173,
    "DE-": "-",
    "DEd": 16,
    "DEm": 42,
    "DEs": 58.017,
    "e_pos": 0.01,
    "pmRA": -0.03847,
    "pmDE": -1.2053,
    "Plx": 0.37500,
    "Vmag": -1.46,
    "B-V": 0.009,
}
"""Rounded from the Bright Star Catalogue and Hipparcos; the Skymap number is made up."""
