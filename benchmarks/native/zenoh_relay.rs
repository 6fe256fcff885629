//! The bare relay to Zenoh in Rust; it does what ../relay.py does.
//!
//!     zenoh-relay CONFIG PORT [KEY SCHEMA FIRST LAST]...
//!
//! CONFIG is Zenoh's configuration in JSON. Of each frame that arrives from PORT of this computer, the bytes from
//! FIRST to before LAST are published on KEY. FIRST is negative if they begin before the frame's packet.

use std::io::{Read, Write};
use std::net::TcpStream;

use zenoh::Wait;
use zenoh::bytes::Encoding;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;

const REQUEST: &[u8] = b"\0\0\0\x1e\0\0\0\x01StreamFrames AllFrames";
const READ_BYTES: usize = 256 * 1024;

struct Cut<'a> {
    first: isize,
    last: usize,
    publisher: Publisher<'a>,
}

/// Serve one connection until the server ends it.
fn relay(port: u16, cuts: &[Cut]) -> zenoh::Result<()> {
    let lead = cuts[0].first.unsigned_abs();
    let mut server = TcpStream::connect(("127.0.0.1", port))?;
    server.write_all(REQUEST)?;
    let mut unread = vec![0; lead];
    let mut read = vec![0; READ_BYTES];
    loop {
        let num_bytes = server.read(&mut read)?;
        if num_bytes == 0 {
            return Ok(());
        }
        unread.extend_from_slice(&read[..num_bytes]);
        let mut at = lead;
        while unread.len() - at >= 8 {
            let size = u32::from_be_bytes(unread[at..at + 4].try_into()?) as usize;
            if unread.len() - at < size {
                break;
            }
            if unread[at + 7] == 3 {
                for cut in cuts {
                    let first = at.checked_add_signed(cut.first).expect("after the lead");
                    cut.publisher.put(&unread[first..at + cut.last]).wait()?;
                }
            }
            at += size;
        }
        unread.drain(..at - lead);
    }
}

fn main() -> zenoh::Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, config, port, wanted @ ..] = arguments.as_slice() else {
        return Err("usage: zenoh-relay CONFIG PORT [KEY SCHEMA FIRST LAST]...".into());
    };
    let session = zenoh::open(zenoh::Config::from_json5(config)?).wait()?;
    let mut cuts = Vec::new();
    for each in wanted.chunks_exact(4) {
        let publisher = session
            .declare_publisher(each[0].clone())
            .encoding(Encoding::from("application/x-lcm").with_schema(&each[1]))
            .congestion_control(CongestionControl::Drop)
            .wait()?;
        cuts.push(Cut { first: each[2].parse()?, last: each[3].parse()?, publisher });
    }
    loop {
        relay(port.parse()?, &cuts)?;
    }
}
