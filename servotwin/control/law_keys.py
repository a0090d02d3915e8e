"""Keys that every law with a dead zone and limits has, declared once."""

from typing import Annotated

from servotwin.config.keys import key

VoltageLimit = Annotated[
    float | None, key("voltage_limit_v", above=0.0, help="Largest command, either sign; no limit where absent.")
]
RateLimit = Annotated[
    float | None,
    key("rate_limit_v_per_s", above=0.0, help="Largest rate of change of the command; no limit where absent."),
]
SampleRate = Annotated[
    float | None, key("sample_rate_hz", above=0.0, help="Rate of the law; it runs in continuous time where absent.")
]
ReleaseTime = Annotated[
    float | None,
    key(
        "release_time_s",
        above=0.0,
        help="Time constant with which the offset of the command after a change of the setting fades; where absent "
        "five over the loop's first gain crossover, 0.5 s of a law whose machine is not known.",
    ),
]
