//! Print the markers that a gateway publishes on LCM.
//!
//!     make -C examples rust && examples/build/rust/release/subscriber [SOURCE [COUNT]]     for example: LAB 100
//!     cd examples/rust && cargo run --release -- [SOURCE [COUNT]]                          the same, without make
//!
//! Building needs Linux, Rust 1.63 or newer, and no other crate: the program reads LCM's packets and the messages by the
//! tables of docs/reference/messages.md. SOURCE is the name of the source in upper case. The program stops after COUNT
//! frames. The environment variable LCM_DEFAULT_URL sets the LCM URL. With --vectors, the program decodes messages from
//! standard input instead (lcm_types/vectors/README.md).

use std::collections::HashMap;
use std::error::Error;
use std::io::{self, BufRead, Write};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::os::unix::io::FromRawFd;
use std::time::{Duration, SystemTime};
use std::{env, process};

type Result<T> = std::result::Result<T, Box<dyn Error>>;

// The messages.

/// A value that is encoded in big-endian order, without padding.
trait Value: Sized {
    fn read(reader: &mut Reader) -> Result<Self>;
    fn json(&self) -> String;
}

/// The bytes that are not read yet.
struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let bytes = self.0.get(..N).ok_or("the message is too short")?;
        self.0 = &self.0[N..];
        Ok(bytes.try_into()?)
    }
}

macro_rules! integers {
    ($($type:ty)*) => {$(
        impl Value for $type {
            fn read(reader: &mut Reader) -> Result<Self> {
                Ok(<$type>::from_be_bytes(reader.take()?))
            }
            fn json(&self) -> String {
                self.to_string()
            }
        }
    )*};
}

integers! { i32 i64 u16 u32 u64 }

impl Value for bool {
    fn read(reader: &mut Reader) -> Result<Self> {
        Ok(reader.take()? != [0])
    }
    fn json(&self) -> String {
        self.to_string()
    }
}

impl Value for f32 {
    fn read(reader: &mut Reader) -> Result<Self> {
        Ok(f32::from_be_bytes(reader.take()?))
    }
    fn json(&self) -> String {
        match self {
            value if value.is_finite() => format!("{value:e}"),
            value if value.is_nan() => r#""nan""#.to_string(),
            value => format!(r#""{value}""#), // inf or -inf
        }
    }
}

impl<T: Value + Copy + Default, const N: usize> Value for [T; N] {
    fn read(reader: &mut Reader) -> Result<Self> {
        let mut items = [T::default(); N];
        for item in &mut items {
            *item = T::read(reader)?;
        }
        Ok(items)
    }
    fn json(&self) -> String {
        json_array(self)
    }
}

fn json_array<T: Value>(items: &[T]) -> String {
    let items: Vec<_> = items.iter().map(Value::json).collect();
    format!("[{}]", items.join(","))
}

/// Declares structs whose fields are encoded one behind the other.
macro_rules! structs {
    ($(struct $name:ident { $($field:ident: $type:ty,)* })*) => {$(
        struct $name { $($field: $type,)* }

        impl $name {
            fn json_fields(&self) -> String {
                [$(format!(r#""{}":{}"#, stringify!($field), self.$field.json())),*].join(",")
            }
        }

        impl Value for $name {
            fn read(reader: &mut Reader) -> Result<Self> {
                Ok(Self { $($field: Value::read(reader)?,)* })
            }
            fn json(&self) -> String {
                format!("{{{}}}", self.json_fields())
            }
        }
    )*};
}

structs! {
    struct Prefix {
        utime: i64,
        capture_utime: i64,
        sequence: i64,
        session: i32,
        parameters_version: i32,
        frame_number: i32,
        timestamp: i64,
    }

    struct Marker {
        x: f32,
        y: f32,
        z: f32,
        reliability: f32,
    }

    struct Tool {
        q0: f32,
        qx: f32,
        qy: f32,
        qz: f32,
        x: f32,
        y: f32,
        z: f32,
        error: f32,
    }

    struct Force {
        fx: f32,
        fy: f32,
        fz: f32,
        mx: f32,
        my: f32,
        mz: f32,
    }

    struct Event {
        id: i32,
        timestamp: i64,
        param1: i32,
        param2: i32,
        param3: i32,
    }

    struct Pose {
        visible: bool,
        position_m: [f32; 3],
        orientation_xyzw: [f32; 4],
        error_m: f32,
    }
}

/// A type of message: what comes behind the prefix.
trait Message: Sized {
    const TYPE: &'static str;
    const FINGERPRINT: u64;
    fn read_body(reader: &mut Reader) -> Result<Self>;
    fn json_body(&self) -> String;
}

/// One item of a component, which is a message of any number of them.
trait Item: Value {
    const TYPE: &'static str;
    const FINGERPRINT: u64;
    const COUNT: &'static str;
    const ITEMS: &'static str;
}

macro_rules! items {
    ($($item:ty: $type:literal, $fingerprint:literal, $count:literal, $items:literal;)*) => {$(
        impl Item for $item {
            const TYPE: &'static str = $type;
            const FINGERPRINT: u64 = $fingerprint;
            const COUNT: &'static str = $count;
            const ITEMS: &'static str = $items;
        }
    )*};
}

items! {
    Marker: "markers_t", 0xe95d5a478ce229e4, "num_markers", "markers";
    Tool: "tools_t", 0xf922a353b61657b3, "num_tools", "tools";
    f32: "analog_t", 0xcd43a9dd46669bec, "num_channels", "voltages";
    Force: "forces_t", 0xdc94defbb591810c, "num_plates", "plates";
    Event: "events_t", 0x06a109c2ae7bf07c, "num_events", "events";
}

impl<T: Item> Message for Vec<T> {
    const TYPE: &'static str = T::TYPE;
    const FINGERPRINT: u64 = T::FINGERPRINT;
    fn read_body(reader: &mut Reader) -> Result<Self> {
        // A wrong number of items ends at the end of the message.
        (0..u32::try_from(i32::read(reader)?)?)
            .map(|_| T::read(reader))
            .collect()
    }
    fn json_body(&self) -> String {
        format!(
            r#""{}":{},"{}":{}"#,
            T::COUNT,
            self.len(),
            T::ITEMS,
            json_array(self)
        )
    }
}

impl Message for Pose {
    const TYPE: &'static str = "tool_pose_t";
    const FINGERPRINT: u64 = 0xbf985441ca59ae7a;
    fn read_body(reader: &mut Reader) -> Result<Self> {
        Self::read(reader)
    }
    fn json_body(&self) -> String {
        self.json_fields()
    }
}

/// Decode a message, or return an error for bytes that are not a message of this type.
fn decode<M: Message>(message: &[u8]) -> Result<(Prefix, M)> {
    let mut reader = Reader(message);
    if u64::read(&mut reader)? != M::FINGERPRINT {
        return Err(format!("this is not a {}: it has another fingerprint", M::TYPE).into());
    }
    let (prefix, body) = (Prefix::read(&mut reader)?, M::read_body(&mut reader)?);
    if !reader.0.is_empty() {
        return Err("the message is too long".into());
    }
    Ok((prefix, body))
}

// LCM's packets: a whole message, or a fragment of one.

const MAGIC_MESSAGE: u32 = 0x4c433032; // "LC02"
const MAGIC_FRAGMENT: u32 = 0x4c433033; // "LC03"
const MAX_MESSAGE_BYTES: usize = 1 << 20;
const MAX_SENDERS: usize = 8;

structs! {
    struct FragmentHeader {
        message_bytes: u32,
        offset: u32,
        number: u16,
        count: u16,
    }
}

struct PartialMessage {
    sequence: u32,
    channel: String,
    data: Vec<u8>,
    received: Vec<bool>,
}

/// Joins the fragments of messages. Like LCM itself, it keeps one incomplete message for each sender.
#[derive(Default)]
struct Assembler(HashMap<SocketAddr, PartialMessage>);

impl Assembler {
    /// Return the channel and the message that a packet completes; an error if it is no packet of LCM.
    fn add(&mut self, sender: SocketAddr, packet: &[u8]) -> Result<Option<(String, Vec<u8>)>> {
        let mut reader = Reader(packet);
        let (magic, sequence) = (u32::read(&mut reader)?, u32::read(&mut reader)?);
        if magic == MAGIC_MESSAGE {
            let (channel, data) = cut_channel(reader.0)?;
            return Ok(Some((channel, data.to_vec())));
        }
        let header = FragmentHeader::read(&mut reader)?;
        let (size, count) = (header.message_bytes as usize, usize::from(header.count));
        if magic != MAGIC_FRAGMENT || size > MAX_MESSAGE_BYTES {
            return Err("no message of LCM, or a message that is too long".into());
        }
        let mut partial = self
            .0
            .remove(&sender)
            .filter(|earlier| {
                (earlier.sequence, earlier.data.len(), earlier.received.len())
                    == (sequence, size, count)
            })
            .unwrap_or_else(|| PartialMessage {
                sequence,
                channel: String::new(),
                data: vec![0; size],
                received: vec![false; count],
            });
        let mut data = reader.0;
        if header.number == 0 {
            (partial.channel, data) = cut_channel(data)?;
        }
        let start = header.offset as usize;
        let place = partial
            .data
            .get_mut(start..start + data.len())
            .ok_or("a fragment behind the end")?;
        place.copy_from_slice(data);
        *partial
            .received
            .get_mut(usize::from(header.number))
            .ok_or("a fragment too many")? = true;
        if !partial.received.contains(&false) {
            return Ok(Some((partial.channel, partial.data)));
        }
        if self.0.len() >= MAX_SENDERS {
            self.0.clear();
        }
        self.0.insert(sender, partial);
        Ok(None)
    }
}

/// Split the name of the channel, which ends with a NUL, from the data behind it.
fn cut_channel(data: &[u8]) -> Result<(String, &[u8])> {
    let end = data
        .iter()
        .position(|byte| *byte == 0)
        .ok_or("no channel")?;
    Ok((
        String::from_utf8_lossy(&data[..end]).into_owned(),
        &data[end + 1..],
    ))
}

// The subscriber.

/// Join the multicast group of $LCM_DEFAULT_URL, such as udpm://239.255.76.67:7667?ttl=1, on this or a following port.
fn open_lcm(following: u16) -> Result<(UdpSocket, SocketAddrV4)> {
    let url = env::var("LCM_DEFAULT_URL").unwrap_or_default();
    let url = if url.is_empty() {
        "udpm://239.255.76.67:7667"
    } else {
        &url
    };
    let address = url
        .strip_prefix("udpm://")
        .and_then(|rest| rest.split('?').next());
    let mut group: SocketAddrV4 = address.and_then(|text| text.parse().ok()).ok_or_else(|| {
        format!("{url}: this program needs a URL such as udpm://239.255.76.67:7667?ttl=1")
    })?;
    group.set_port(group.port().wrapping_add(following));
    let socket = bind_shared(group.port())?;
    socket.join_multicast_v4(group.ip(), &Ipv4Addr::UNSPECIFIED)?;
    let ttl = url.split("ttl=").nth(1).and_then(|ttl| ttl.parse().ok());
    socket.set_multicast_ttl_v4(ttl.unwrap_or(0))?;
    Ok((socket, group))
}

/// Bind a UDP socket to a port that other programs use, too. std cannot do that; the crate socket2 can on all systems.
fn bind_shared(port: u16) -> io::Result<UdpSocket> {
    use std::os::raw::c_int;
    // Linux's types and constants.
    #[repr(C)]
    struct InternetAddress {
        family: u16,
        port_and_host: [u8; 6],
        zero: [u8; 8],
    }
    extern "C" {
        fn socket(domain: c_int, kind: c_int, protocol: c_int) -> c_int;
        fn setsockopt(
            fd: c_int,
            level: c_int,
            name: c_int,
            value: *const c_int,
            length: u32,
        ) -> c_int;
        fn bind(fd: c_int, address: *const InternetAddress, length: u32) -> c_int;
    }
    const AF_INET: c_int = 2;
    const SOCK_DGRAM: c_int = 2;
    const SOL_SOCKET: c_int = 1;
    const SO_REUSEADDR: c_int = 2;
    const SO_RCVBUF: c_int = 8;

    let [high, low] = port.to_be_bytes();
    let address = InternetAddress {
        family: AF_INET as u16,
        port_and_host: [high, low, 0, 0, 0, 0],
        zero: [0; 8],
    };
    // Linux allows at most net.core.rmem_max for the buffer.
    let options = [(SO_REUSEADDR, 1), (SO_RCVBUF, 2_000_000)];
    // SAFETY: the pointers are valid during each call, with these lengths; `socket` owns the new file descriptor.
    unsafe {
        let fd = socket(AF_INET, SOCK_DGRAM, 0);
        if fd < 0 {
            return Err(io::Error::last_os_error());
        }
        let socket = UdpSocket::from_raw_fd(fd);
        for (name, value) in options {
            if setsockopt(fd, SOL_SOCKET, name, &value, 4) != 0 {
                return Err(io::Error::last_os_error());
            }
        }
        if bind(fd, &address, 16) != 0 {
            return Err(io::Error::last_os_error());
        }
        Ok(socket)
    }
}

/// Asks the gateway for frames that were lost. Requests, and what it sends again, go to the port behind LCM's.
struct Refill<'a> {
    source: &'a str,
    socket: UdpSocket,
    group: SocketAddrV4,
    assembler: Assembler,
    requester: String,
    requests: u64,
}

impl Refill<'_> {
    /// Return the frames with these numbers that the gateway still has: it asks as long as any come.
    fn get(&mut self, first: i64, last: i64) -> Result<Vec<(Prefix, Vec<Marker>)>> {
        let wanted = format!("MOCAP_{}_3D_REFILL", self.source);
        let (mut found, mut next, mut tries_left) = (Vec::new(), first, 5);
        let mut packet = [0; 65536];
        while next <= last && tries_left > 0 {
            tries_left -= 1;
            let request = self.request(next, last);
            self.socket.send_to(&request, self.group)?;
            // Until nothing has come for the timeout of the socket.
            while let (true, Ok((length, sender))) =
                (next <= last, self.socket.recv_from(&mut packet))
            {
                let message = match self.assembler.add(sender, &packet[..length]) {
                    Ok(Some((channel, message))) if channel == wanted => message,
                    _ => continue,
                };
                if let Ok(frame) = decode::<Vec<Marker>>(&message) {
                    if frame.0.sequence == next {
                        (next, tries_left) = (next + 1, 5);
                        found.push(frame);
                    }
                }
            }
        }
        Ok(found)
    }

    /// Return LCM's packet with a command_request_t.
    fn request(&mut self, first: i64, last: i64) -> Vec<u8> {
        self.requests += 1;
        let text = |value: String| {
            let length = (value.len() as u32 + 1).to_be_bytes();
            [&length[..], value.as_bytes(), b"\0"].concat()
        };
        let channel = format!("MOCAP_{}_COMMAND_REQUEST\0", self.source);
        [
            &MAGIC_MESSAGE.to_be_bytes()[..],
            &(self.requests as u32).to_be_bytes(),
            channel.as_bytes(),
            &0x4514334e0ab92347_u64.to_be_bytes(), // the fingerprint
            &self.requests.to_be_bytes(),
            &text(self.requester.clone()),
            &text("history".to_string()),
            &3_i32.to_be_bytes(), // options
            &text("key=3d".to_string()),
            &text(format!("from={first}")),
            &text(format!("to={last}")),
        ]
        .concat()
    }
}

fn subscribe(source: &str, count: u64) -> Result<()> {
    let wanted = format!("MOCAP_{source}_3D");
    let (socket, _) = open_lcm(0)?;
    let (queries, group) = open_lcm(1)?;
    queries.set_read_timeout(Some(Duration::from_millis(200)))?;
    let mut refill = Refill {
        source,
        socket: queries,
        group,
        assembler: Assembler::default(),
        requester: format!("subscriber.rs {} at {:?}", process::id(), SystemTime::now()),
        requests: 0,
    };
    let mut newest = None;
    println!("listening");
    let mut assembler = Assembler::default();
    let mut packet = [0; 65536];
    let mut received = 0;
    while count == 0 || received < count {
        let (length, sender) = socket.recv_from(&mut packet)?;
        let message = match assembler.add(sender, &packet[..length]) {
            Ok(Some((channel, message))) if channel == wanted => message,
            _ => continue, // another channel, an incomplete message, or no packet of LCM
        };
        match decode::<Vec<Marker>>(&message) {
            Ok((prefix, markers)) => {
                let first = newest.map_or(prefix.sequence, |number: i64| number + 1);
                newest = Some(prefix.sequence);
                let mut frames = refill.get(first, prefix.sequence - 1)?;
                frames.push((prefix, markers));
                for (prefix, markers) in &frames {
                    if count == 0 || received < count {
                        print_markers(prefix, markers)?;
                        received += 1;
                    }
                }
            }
            Err(error) => eprintln!("ignored a malformed message on {wanted}: {error}"),
        }
    }
    Ok(())
}

fn print_markers(prefix: &Prefix, markers: &[Marker]) -> io::Result<()> {
    let visible: Vec<_> = markers.iter().filter(|marker| !marker.x.is_nan()).collect();
    let position = visible
        .first()
        .map_or(String::new(), |Marker { x, y, z, .. }| {
            format!(", the first at {x:.3}, {y:.3}, {z:.3} mm")
        });
    writeln!(
        io::stdout(),
        "#{} frame {} at {:.4} s with parameters {}: {} of {} markers in view{position}",
        prefix.sequence,
        prefix.frame_number,
        prefix.timestamp as f64 / 1e6,
        prefix.parameters_version,
        visible.len(),
        markers.len(),
    )
}

/// Decode each line "TYPE HEX" of standard input, and print one line of JSON for it.
fn print_vectors() -> Result<()> {
    for line in io::stdin().lock().split(b'\n') {
        let json = match decoded_json(&String::from_utf8_lossy(&line?)) {
            Ok(json) => json,
            Err(error) => format!(r#"{{"error":"{}"}}"#, error.to_string().escape_default()),
        };
        writeln!(io::stdout(), "{json}")?;
    }
    Ok(())
}

fn decoded_json(line: &str) -> Result<String> {
    let mut words = line.split_whitespace();
    let type_name = words.next().unwrap_or_default();
    let message = from_hex(words.next().unwrap_or_default())?;
    match type_name {
        "markers_t" => message_json::<Vec<Marker>>(&message),
        "tools_t" => message_json::<Vec<Tool>>(&message),
        "analog_t" => message_json::<Vec<f32>>(&message),
        "forces_t" => message_json::<Vec<Force>>(&message),
        "events_t" => message_json::<Vec<Event>>(&message),
        "tool_pose_t" => message_json::<Pose>(&message),
        _ => Err("no such type".into()),
    }
}

fn message_json<M: Message>(message: &[u8]) -> Result<String> {
    let (prefix, body) = decode::<M>(message)?;
    Ok(format!("{{{},{}}}", prefix.json_fields(), body.json_body()))
}

fn from_hex(digits: &str) -> Result<Vec<u8>> {
    if digits.len() % 2 != 0 || !digits.bytes().all(|digit| digit.is_ascii_hexdigit()) {
        return Err("this is not hexadecimal".into());
    }
    (0..digits.len())
        .step_by(2)
        .map(|start| Ok(u8::from_str_radix(&digits[start..start + 2], 16)?))
        .collect()
}

fn run(arguments: &[String]) -> Result<()> {
    let source = arguments.first().map_or("LAB", String::as_str);
    let count = arguments.get(1).map_or("0", String::as_str);
    if source == "--vectors" {
        return print_vectors();
    }
    if source.starts_with('-') {
        println!("Print the markers that a gateway publishes on LCM.");
        println!("usage: subscriber [SOURCE [COUNT]] | --vectors");
        process::exit(if source == "--help" { 0 } else { 2 });
    }
    let count = count
        .parse()
        .map_err(|_| format!("{count} is not a number of frames"))?;
    subscribe(source, count).map_err(|error| {
        format!("cannot receive from LCM; check $LCM_DEFAULT_URL and the multicast route: {error}")
            .into()
    })
}

fn main() {
    let arguments: Vec<String> = env::args().skip(1).collect();
    if let Err(error) = run(&arguments) {
        eprintln!("{error}");
        process::exit(1);
    }
}
