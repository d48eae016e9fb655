"""Environment variables: names, kinds, defaults, domains and meanings.

Nothing else in the package reads the environment. A value is read at each call, not at import, so a test or a flag of
``serve`` may set it first. An unknown spelling of a boolean gives the safe value and one warning; a number out of its
domain gives the default and one warning.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

logger = logging.getLogger(__name__)

TRUE_SPELLINGS = frozenset({"1", "true", "yes", "on"})
FALSE_SPELLINGS = frozenset({"0", "false", "no", "off"})

NO_ENDPOINT = "none"
"""Value of ``STRANDS_MESH_CONNECT`` and ``STRANDS_MESH_LISTEN`` that names no endpoint."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One environment variable; its default is text."""

    name: str
    kind: str
    default: str
    meaning: str
    low: float | None = None
    high: float | None = None


_TABLE: dict[str, Setting] = {}
_warned: set[tuple[str, str]] = set()
_put: set[str] = set()
"""Names that this process has set itself."""


def _declare(*settings: Setting) -> None:
    for setting in settings:
        _TABLE[setting.name] = setting


_declare(
    # The framework's own names, honoured as it documents them.
    Setting("DEVICE_CONNECT_ALLOW_INSECURE", "boolean", "false", "Opt in to a transport without authentication."),
    Setting(
        "DEVICE_CONNECT_DISCOVERY_MODE",
        "text",
        "d2d",
        "Discovery of devices: d2d (device to device, by presence) or registry.",
    ),
    Setting("MESSAGING_BACKEND", "text", "zenoh", "Transport of Device Connect: zenoh or nats."),
    Setting("MESSAGING_URLS", "list", "", "Broker or peer URLs of Device Connect."),
    Setting("MESSAGING_CREDENTIALS_FILE", "path", "", "Device Connect credentials file (JSON)."),
    Setting("MESSAGING_TLS_CA_FILE", "path", "", "Certificate authority that peers are checked against (PEM)."),
    Setting("MESSAGING_TLS_CERT_FILE", "path", "", "This device's certificate (PEM)."),
    Setting("MESSAGING_TLS_KEY_FILE", "path", "", "This device's private key (PEM)."),
    Setting("NATS_URL", "text", "", "NATS server URL."),
    Setting("NATS_URLS", "list", "", "NATS server URLs."),
    Setting("NATS_CREDENTIALS_FILE", "path", "", "NATS credentials file."),
    Setting("ZENOH_CONNECT", "list", "", "Zenoh endpoints to connect to, such as tcp/127.0.0.1:7447."),
    Setting("ZENOH_LISTEN", "list", "", "Zenoh endpoints to listen on."),
    Setting("TENANT", "text", "default", "Device Connect tenant: a fleet that sees no other one."),
    Setting("OTEL_EXPORTER_OTLP_ENDPOINT", "text", "", "Endpoint for traces of calls. Unset: none are recorded."),
    # Ours, on Device Connect.
    Setting(
        "DEVICE_CONNECT_RPC_ALLOW",
        "list",
        "",
        "Callers that may move a robot: globs; '*' any named caller; 'anonymous' the unnamed. "
        "Unset: anyone may move a simulation, no one may move real hardware.",
    ),
    Setting(
        "DEVICE_CONNECT_ESTOP_ALLOW",
        "list",
        "",
        "Sources whose emergencyStop counts: globs. Unset: every named source.",
    ),
    Setting(
        "STRANDS_MESH_POLICY_TYPE_ALLOW",
        "list",
        "",
        "Policy providers that callers may ask for. Unset: all registered.",
    ),
    Setting(
        "STRANDS_ROBOT_COMMAND_ALLOW",
        "list",
        "",
        "Motion verbs the operator approves on real hardware: 'verb', 'verb@peer' or 'verb@peer:caller' (a glob).",
    ),
    Setting(
        "STRANDS_ROS2_COMMAND_ALLOW",
        "list",
        "",
        "ROS commands the operator approves: a surface such as cmd_vel, or a glob over names such as /turtle1/*.",
    ),
    Setting(
        "STRANDS_ROS2_BRIDGE_I_KNOW_THIS_IS_INSECURE",
        "boolean",
        "false",
        "Opt in to joint commands from a ROS 2 graph that is not secured.",
    ),
    Setting("ROS_DOMAIN_ID", "integer", "0", "DDS domain of ROS 2 robots.", 0, 232),
    Setting("ROS_LOCALHOST_ONLY", "boolean", "false", "Keep DDS on this machine, unless CYCLONEDDS_URI is set."),
    Setting("ROS_SECURITY_ENABLE", "text", "", "ROS 2's own security switch: on only for exactly true."),
    Setting("ROS_SECURITY_STRATEGY", "text", "", "ROS 2's own rule for a node without keys: Enforce refuses it."),
    Setting("ROS_SECURITY_KEYSTORE", "path", "", "ROS 2's own folder of keys and permissions."),
    Setting("CYCLONEDDS_URI", "text", "", "Configuration of Cyclone DDS; the library reads it."),
    Setting("STRANDS_POLICIES", "path", "", "File of policy profiles, by whose names callers choose a policy."),
    Setting(
        "STRANDS_ALLOW_MOCK", "boolean", "false", "Let the policy mock, which follows no instruction, move hardware."
    ),
    Setting("BYPASS_TOOL_CONSENT", "boolean", "false", "Approve every motion verb on real hardware."),
    Setting("STRANDS_DC_PORT", "integer", "7447", "Loopback port where local robots meet.", 1, 65535),
    Setting(
        "STRANDS_DC_STATE_HZ",
        "number",
        "1",
        "Looks a second at an idle robot, for changes.",
        0.01,
        100,
    ),
    Setting(
        "STRANDS_DC_STATE_BUSY_HZ",
        "number",
        "10",
        "stateUpdate events a second at most.",
        0.01,
        100,
    ),
    Setting("STRANDS_DC_OBSERVATION_HZ", "number", "10", "observationUpdate events a second at most.", 0.01, 100),
    Setting("STRANDS_DC_STREAM_HZ", "number", "50", "streamStep events a second at most.", 0.01, 1000),
    # The native mesh.
    Setting("STRANDS_MESH", "text", "", "false: no mesh at all. true: a bare Robot() joins the mesh."),
    Setting("STRANDS_MESH_BACKEND", "text", "zenoh", "Transport of the mesh: zenoh, iot, bridge or memory."),
    Setting("STRANDS_MESH_PORT", "integer", "7447", "Loopback port of the mesh's hub.", 1, 65535),
    Setting(
        "STRANDS_MESH_CONNECT",
        "list",
        "",
        "Zenoh endpoints that the mesh connects to; none for none. Unset: those of ZENOH_CONNECT.",
    ),
    Setting(
        "STRANDS_MESH_LISTEN",
        "list",
        "",
        "Zenoh endpoints that the mesh listens on; none for none. Unset: those of ZENOH_LISTEN.",
    ),
    Setting("STRANDS_MESH_NAMESPACE", "text", "strands", "Zenoh namespace on top of the mesh's keys."),
    Setting("STRANDS_MESH_MULTICAST", "boolean", "false", "Find peers by multicast on the local network."),
    Setting(
        "STRANDS_MESH_MAX_SESSIONS",
        "integer",
        "512",
        "Zenoh sessions a hub accepts, two a process.",
        1,
        65535,
    ),
    Setting(
        "STRANDS_MESH_MAX_PEERS",
        "integer",
        "1024",
        "Peers kept in the table; a newcomer to a full one is left out.",
        1,
        1_000_000,
    ),
    Setting("STRANDS_MESH_PEER_RETENTION_S", "number", "0", "Seconds a silent peer stays listed.", 0, 10_000_000),
    Setting("STRANDS_MESH_AUTH_MODE", "text", "mtls", "mtls, or none with STRANDS_MESH_I_KNOW_THIS_IS_INSECURE."),
    Setting("STRANDS_MESH_I_KNOW_THIS_IS_INSECURE", "boolean", "false", "Opt in to a mesh without certificates."),
    Setting("STRANDS_MESH_LOCAL_DEV", "boolean", "false", "STRANDS_MESH_AUTH_MODE=none and its opt-in in one."),
    Setting("STRANDS_MESH_TLS_CA", "path", "", "Certificate authority of the mesh (PEM)."),
    Setting("STRANDS_MESH_TLS_CERT", "path", "", "This peer's certificate (PEM)."),
    Setting("STRANDS_MESH_TLS_KEY", "path", "", "This peer's private key (PEM, mode 0600)."),
    Setting("STRANDS_MESH_ACL_FILE", "path", "", "Zenoh access control of the mesh (JSON5)."),
    Setting("STRANDS_MESH_ACCEPT_PERMISSIVE_ACL", "boolean", "false", "Accept access rules that let anyone command."),
    Setting("STRANDS_MESH_REQUIRE_SIGNED_IDENTITY", "text", "auto", "Signed messages only: 1, 0 or auto."),
    Setting(
        "STRANDS_MESH_CONSOLE_PUBLIC_KEYS",
        "list",
        "",
        "Ed25519 keys (base64url) of consoles on other machines that may move real hardware on the mesh.",
    ),
    Setting(
        "STRANDS_MESH_POLICY_HOST_ALLOW",
        "list",
        "",
        "Hosts and CIDRs of policy servers besides loopback; a name is resolved once.",
    ),
    Setting("STRANDS_MESH_HF_REPO_ALLOW", "list", "", "Hub organisations of checkpoints besides the built-in three."),
    Setting("STRANDS_MESH_POSE_HZ", "number", "10", "Pose messages a second.", -1, 1000),
    Setting("STRANDS_MESH_IMU_HZ", "number", "10", "IMU messages a second.", -1, 1000),
    Setting("STRANDS_MESH_ODOM_HZ", "number", "10", "Odometry messages a second.", -1, 1000),
    Setting("STRANDS_MESH_HEALTH_HZ", "number", "0.5", "Health messages a second.", -1, 1000),
    Setting("STRANDS_MESH_LIDAR_SUMMARY_HZ", "number", "5", "Lidar summaries a second.", -1, 1000),
    Setting("STRANDS_MESH_HAND_HZ", "number", "50", "Hand states a second.", -1, 1000),
    Setting("STRANDS_MESH_MAP_INFO_HZ", "number", "0.2", "Map messages a second.", -1, 1000),
    Setting("STRANDS_MESH_CAMERA_HZ", "number", "0", "Camera frames a second and camera; 0 is off.", -1, 1000),
    Setting("STRANDS_MESH_STREAM_HZ", "number", "50", "Policy steps a second at most; 0 is off.", -1, 1000),
    Setting("STRANDS_MESH_CAMERA_DISABLED", "boolean", "false", "Privacy switch: no camera frame is ever built."),
    Setting("STRANDS_MESH_INPUT_MAX_HZ", "number", "100", "Remote actions applied a second; 0 is no cap.", 0, 10_000),
    Setting("STRANDS_MESH_INPUT_VALUE_ABS", "number", "720", "Largest magnitude of a remote action.", 0, 1e6),
    Setting("STRANDS_MESH_INPUT_SLEW_ABS", "number", "1440", "Fastest remote action, units a second.", 0, 1e6),
    Setting("STRANDS_MESH_INPUT_STREAM_TTL_S", "number", "900", "Seconds a remote input stream lives.", 1, 86_400),
    Setting("STRANDS_IOT_ENDPOINT", "text", "", "MQTT 5 endpoint of the iot backend: host or host:port."),
    Setting("STRANDS_IOT_THING_NAME", "text", "", "MQTT client id, certificate name and peer id."),
    Setting("STRANDS_IOT_CERT_DIR", "path", "", "Folder of cert.pem and key.pem of the iot backend."),
    Setting("STRANDS_IOT_CA_FILE", "path", "", "Certificate authority of the MQTT broker (PEM)."),
    Setting("STRANDS_MESH_BRIDGE_TOPICS", "list", "", "Topics the bridge carries to MQTT, by name in the table."),
    # Robots.
    Setting("STRANDS_CONTROL_HZ", "number", "50", "Control loop rate of a rollout.", 1, 2000),
    Setting("STRANDS_ROBOT_MESH_DC", "text", "auto", "Device Connect for the robot_mesh tool: off leaves it out."),
    Setting("REACHY_HOST", "text", "", "Host or host:port of a Reachy Mini where none is named. Unset: found by mDNS."),
    Setting("REACHY_PORT", "integer", "8000", "Port of REACHY_HOST where that has none.", 1, 65535),
    Setting("REACHY_DAEMON_TOKEN", "text", "", "Bearer token that a gateway before a Reachy Mini's daemon asks for."),
    Setting("REACHY_DAEMON_TLS", "boolean", "false", "Dial the daemon of a Reachy Mini by HTTPS and WSS."),
    Setting("REACHY_DAEMON_TLS_INSECURE", "boolean", "false", "With REACHY_DAEMON_TLS: do not check its certificate."),
    Setting("STRANDS_STATE_DIR", "path", "", "Directory for grants, lockouts and keys. Unset: ~/.strands_robots."),
    Setting("STRANDS_TAGS", "list", "", "Tags of the robots of this process, by which callers choose robots."),
    # The calling side.
    Setting(
        "STRANDS_FLEET",
        "text",
        "",
        "Connection profile (name or .toml file) of commands with --fleet, connect() and robot_mesh alone.",
    ),
    Setting(
        "STRANDS_FLEETS_DIR",
        "path",
        "",
        "Folder of connection profiles. Unset: strands-robots/fleets in XDG_CONFIG_HOME.",
    ),
    Setting("XDG_CONFIG_HOME", "path", "", "Folder of this user's configuration. Unset: ~/.config."),
    # Rendering, by names that are not ours.
    Setting("MUJOCO_GL", "text", "", "OpenGL of MuJoCo: egl, osmesa or glfw. Unset: one that works without a display."),
    Setting("DISPLAY", "text", "", "X display; with one, MuJoCo's own choice of OpenGL is kept."),
    # Safety.
    Setting(
        "STRANDS_CELL", "text", "", "Cell of the robots of this process, for stops of one cell. Unset: of every cell."
    ),
    Setting(
        "STRANDS_HALT_DEADLINE_S",
        "number",
        "1.0",
        "Seconds a robot has to halt before it is reported.",
        0.05,
        60,
    ),
    Setting(
        "STRANDS_ESTOP_TORQUE",
        "text",
        "hold",
        "After a stop: hold (stiff), limp, or settle (rest pose, then limp).",
    ),
    Setting(
        "STRANDS_CHECKIN_TIMEOUT_S",
        "number",
        "0",
        "Seconds without a safety controller's check-in after which a robot halts and locks. 0: off.",
        0,
        3600,
    ),
    Setting(
        "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS",
        "list",
        "",
        "Ed25519 keys (base64url) that an emergencyStop must be signed with. Unset: its source is self-asserted.",
    ),
    Setting(
        "STRANDS_ESTOP_REQUIRE_SIGNED",
        "boolean",
        "false",
        "Act on signed emergency stops alone, on both networks; DEVICE_CONNECT_ESTOP_PUBLIC_KEYS must hold a key.",
    ),
    Setting(
        "STRANDS_MESH_RESUME_PUBLIC_KEY",
        "list",
        "",
        "Ed25519 keys (base64url) of the operators who may resume a robot. Unset: no signed resume is admitted.",
    ),
    Setting("STRANDS_MESH_AUDIT_DIR", "path", "", "Directory of the safety audit. Unset: ~/.strands_robots."),
    Setting(
        "STRANDS_MESH_AUDIT_PSK",
        "text",
        "",
        "Secret that signs each audit record (HMAC-SHA256); a process keeps that of its first record.",
    ),
)

UNREAD: dict[str, str] = {
    name: instead
    for names, instead in (
        # Who may command.
        (
            "STRANDS_MESH_HITL_ACTIONS STRANDS_POSE_COMMAND_ALLOW STRANDS_DASH_TASK_REQUIRES_CONFIRM "
            "STRANDS_DASH_AGENT_PHYSICAL_MOTION",
            "Motions of real hardware are approved at the robot: STRANDS_ROBOT_COMMAND_ALLOW, or a one-time grant.",
        ),
        (
            "STRANDS_ROBOT_MESH_AGENT_ID DEVICE_CONNECT_CLIENT_ID",
            "The tool calls as robot-mesh-tool: name that in DEVICE_CONNECT_RPC_ALLOW at the robots.",
        ),
        ("STRANDS_DASH_MOTION_GRANT_TTL_S", "A grant lives for 300 s; strands-robots grant --for states another time."),
        ("STRANDS_SERIAL_COMMAND_ALLOW", "No tool here writes to a serial bus; a robot's verbs do."),
        ("STRANDS_UNITREE_COMMAND_ALLOW", "No driver of these robots is here; a driver of your own brings its verbs."),
        (
            "STRANDS_TRUST_REMOTE_CODE",
            "Code of a checkpoint is never run; serve such a policy elsewhere and ask it by policy_provider remote.",
        ),
        # Device Connect.
        ("NATS_TLS_CA_FILE", "Set MESSAGING_TLS_CA_FILE."),
        ("NATS_TLS_CERT_FILE", "Set MESSAGING_TLS_CERT_FILE."),
        ("NATS_TLS_KEY_FILE", "Set MESSAGING_TLS_KEY_FILE."),
        # The mesh.
        (
            "STRANDS_MESH_OVERRIDE_CODE",
            "No shared code ends a lockout; set STRANDS_MESH_RESUME_PUBLIC_KEY and resume with the operator's key.",
        ),
        (
            "STRANDS_MESH_RESUME_SIGNING_KEY_FILE",
            "Give the key's file to strands-robots resume --key or to fleet.resume().",
        ),
        ("STRANDS_MESH_RESUME_FRESHNESS_S", "A resume counts for 60 s after it was signed."),
        ("STRANDS_MESH_RESUME_FORWARD_SKEW_S", "A resume may be 5 s ahead of the robot's clock."),
        (
            "STRANDS_MESH_RESUME_MAX_FAILS STRANDS_MESH_RESUME_BACKOFF_S",
            "After five refused resumes a robot accepts none for 30 s.",
        ),
        (
            "STRANDS_MESH_RESUME_REPLAY_CACHE_MAX",
            "A robot remembers the last 4096 resumes.",
        ),
        (
            "STRANDS_MESH_CMD_RATE_HZ STRANDS_MESH_SAFETY_RATE_HZ",
            "Rates are bounded by topic, as docs/mesh.md lists them; a stop finds a place in every flood.",
        ),
        (
            "STRANDS_MESH_MAX_CMD_BYTES STRANDS_MESH_MAX_SAFETY_BYTES STRANDS_MESH_MAX_CAMERA_BYTES",
            "Sizes are bounded by topic, as docs/mesh.md lists them.",
        ),
        (
            "STRANDS_MESH_FALLBACK_MODE",
            "A process that cannot be the hub of STRANDS_MESH_PORT connects to it; other endpoints are "
            "STRANDS_MESH_CONNECT and STRANDS_MESH_LISTEN.",
        ),
        ("STRANDS_MESH_FILTER_INTERFACES", "Name the interface's address in STRANDS_MESH_LISTEN."),
        ("STRANDS_MESH_GATEWAY_DISCOVERY_WAIT_S", "The tool waits as long as its answer takes."),
        ("STRANDS_MESH_SUBSCRIBE_ALLOW", "No tool reads raw topics; connect() follows a robot's events and state."),
        ("STRANDS_MESH_INPUT_AUDIT_EVERY", "The audit has the begin of every input stream, and its loss or end."),
        (
            "STRANDS_TELEOP_SLEW_ABS",
            "The robot's own speed_limit bounds a leader, and over the mesh STRANDS_MESH_INPUT_SLEW_ABS does.",
        ),
        (
            "STRANDS_MAX_TARGET_LINEAR_VELOCITY_MPS STRANDS_MAX_TARGET_ANGULAR_VELOCITY_RPS",
            "Give max_linear and max_angular to the base's class.",
        ),
        # The mesh over MQTT.
        (
            "STRANDS_MESH_IOT_DIRECT STRANDS_IOT_DIRECT_AUTH",
            "Commands and answers go over MQTT topics, authenticated by the certificate in STRANDS_IOT_CERT_DIR.",
        ),
        (
            "STRANDS_MESH_IOT_CAMERA_INLINE STRANDS_MESH_CAMERA_S3_BUCKET STRANDS_MESH_CAMERA_S3_PREFIX "
            "STRANDS_MESH_CAMERA_PRESIGN_TTL",
            "No picture is sent over MQTT.",
        ),
        (
            "STRANDS_MESH_CA_PINS STRANDS_MESH_DISABLE_CA_PIN",
            "Nothing here provisions AWS; STRANDS_IOT_CA_FILE is the authority that the broker is checked against.",
        ),
        ("STRANDS_MESH_BRIDGE_TOPICS_PREFIX", "Name the topics in STRANDS_MESH_BRIDGE_TOPICS; answers are carried."),
        (
            "STRANDS_MESH_DEDUP_TTL STRANDS_MESH_BRIDGE_DEDUP_STRICT",
            "A command that arrives over both legs of the bridge is always carried out once.",
        ),
        # The audit.
        (
            "STRANDS_MESH_AUDIT_MAX_BYTES STRANDS_MESH_AUDIT_MAX_FILES",
            "The audit is rotated at 100 MiB with five older files; the first record of each stop is kept beyond that.",
        ),
        # Robots.
        ("STRANDS_ROBOT_MODE", 'Give mode="real" or mode="sim" to Robot(), or --mode to serve.'),
        ("STRANDS_BASE_DIR", "STRANDS_STATE_DIR is the folder of lockouts, grants and keys."),
        ("STRANDS_ASSETS_DIR", "Give Robot() or serve the path of the MJCF or URDF file."),
        ("REACHY_TTS_URL", "The driver plays no sound."),
        (
            "STRANDS_ROBOTS_FOXGLOVE STRANDS_FOXGLOVE_COMMAND_ALLOW",
            "No Foxglove server is here; serve --record writes MCAP files, which Foxglove opens.",
        ),
        # The operator's page.
        (
            "DASHBOARD_AUTH_TOKEN STRANDS_DASH_AUTH_ENABLED STRANDS_DASH_AUTH_BOOTSTRAP_TOKEN "
            "STRANDS_DASH_AUTH_ENROLL_TOKEN_FILE STRANDS_DASH_AUTH_TOKEN_TTL",
            "The page is on 127.0.0.1 alone; dashboard --listen adds TLS and makes a token.",
        ),
        (
            "DASHBOARD_CORS_ORIGINS STRANDS_DASH_CONNECT_ORIGINS STRANDS_DASH_AUTH_ORIGIN STRANDS_DASH_AUTH_RP_ID",
            "The page answers to its own origins alone: 127.0.0.1, and the address of dashboard --listen.",
        ),
        (
            "STRANDS_DASHBOARD_AUTOSPAWN STRANDS_DASHBOARD_AUTOSPAWN_REAL_SERIALS "
            "STRANDS_DASH_REAL_SPAWN_WITHOUT_MESH_AUTH STRANDS_DASHBOARD_PROFILES",
            "The page starts no robot; strands-robots serve does.",
        ),
        ("STRANDS_DASHBOARD_PEER_ID", "Give the page's name to dashboard --as."),
    )
    for name in names.split()
}
"""Settings of strands-robots 0.5 that are not read here, and what to set or do instead of each."""


def warn_of_unread() -> None:
    """Log each variable of :data:`UNREAD` that is set, once, with what to do instead.

    Every start of a robot or of the page calls this.
    """
    for name, instead in UNREAD.items():
        if os.environ.get(name, "").strip() and (name, "") not in _warned:
            _warned.add((name, ""))
            logger.warning("%s is set and not read here. %s", name, instead)


def warn_at_join() -> None:
    """Log unread settings, and that a list of callers restricts no stop.

    In strands-robots 0.5 such a list did. One that this process set itself, by a flag of ``serve``, is of this version.
    """
    warn_of_unread()
    callers, sources = "DEVICE_CONNECT_RPC_ALLOW", "DEVICE_CONNECT_ESTOP_ALLOW"
    if is_set(callers) and callers not in _put and not is_set(sources) and (sources, "") not in _warned:
        _warned.add((sources, ""))
        logger.warning(
            "%s is set and %s is not: every named source may stop and lock the robots, whoever may move them. "
            "Set %s to restrict that.",
            callers,
            sources,
            sources,
        )


def declared() -> tuple[Setting, ...]:
    """Return every setting, in the order of the table."""
    return tuple(_TABLE.values())


def raw(name: str) -> str:
    """Return the variable's text, stripped; the declared default when unset or blank."""
    return os.environ.get(name, "").strip() or _TABLE[name].default


def verbatim(name: str) -> str:
    """Return the variable unchanged, "" when unset, as another program reads it."""
    return os.environ.get(_TABLE[name].name, "")


def put(name: str, value: str) -> None:
    """Set a declared variable for this process and its children."""
    os.environ[_TABLE[name].name] = value
    _put.add(name)


@contextmanager
def only(values: Mapping[str, str]) -> Iterator[None]:
    """Set these declared variables, and no others, for the block.

    It is the environment of the whole process, so one block at a time.
    """
    before = {name: os.environ.pop(name) for name in _TABLE if name in os.environ}
    try:
        for name, value in values.items():
            put(name, value)
        yield
    finally:
        for name in _TABLE:
            os.environ.pop(name, None)
        os.environ.update(before)


def is_set(name: str) -> bool:
    """Return True when the variable has anything but blanks."""
    return bool(os.environ.get(_TABLE[name].name, "").strip())


def boolean(name: str, *, safe: bool = False) -> bool:
    """Return a switch; an unknown spelling gives ``safe`` and one warning."""
    spelling = raw(name).lower()
    if spelling in TRUE_SPELLINGS:
        return True
    if spelling in FALSE_SPELLINGS:
        return False
    _warn_once(name, spelling, f"is no boolean; taken as {str(safe).lower()}, the safe side")
    return safe


def number(name: str) -> float:
    """Return a number in the setting's domain, else its default and one warning."""
    setting, spelling = _TABLE[name], raw(name)
    try:
        value = float(spelling)
    except ValueError:
        value = math.nan
    low = -math.inf if setting.low is None else setting.low
    high = math.inf if setting.high is None else setting.high
    if math.isfinite(value) and low <= value <= high:
        return value
    _warn_once(name, spelling, f"is no number from {low:g} to {high:g}; {setting.default} is used")
    return float(setting.default)


def integer(name: str) -> int:
    """Return an integer in the setting's domain, else its default and a warning."""
    value = number(name)
    if value != int(value):
        _warn_once(name, raw(name), f"is not whole; {_TABLE[name].default} is used")
        return int(_TABLE[name].default)
    return int(value)


def default(name: str) -> str:
    """Return the declared default of a variable."""
    return _TABLE[name].default


def items(name: str) -> tuple[str, ...]:
    """Return the parts of a comma list without blanks; empty when unset."""
    return tuple(part.strip() for part in raw(name).split(",") if part.strip())


def _warn_once(name: str, value: str, complaint: str) -> None:
    if (name, value) not in _warned:
        _warned.add((name, value))
        logger.warning("%s=%r %s.", name, value, complaint)
