//! Many Zenoh subscribers in one process: sessions that count what they receive and miss.
//!
//!     site-subscriber CONFIG SESSIONS KEY...
//!
//! CONFIG is Zenoh's configuration in JSON, the same for all sessions. Each session subscribes to the key
//! expressions KEY. For each line on standard input, the program prints a line of JSON: what each
//! session has received of each key. After the line `take`, it starts to count again. It ends with its input.
//!
//! The messages are those of the gateway (docs/reference/messages.md): `utime` is at byte 8 and `sequence` at
//! byte 24, both big-endian. Keys of parameters carry no such message and are left out.

use std::collections::BTreeMap;
use std::io::{BufRead, Write};
use std::sync::{Arc, Mutex};
use std::time::{SystemTime, UNIX_EPOCH};

use serde_json::{Map, Value, json};
use zenoh::Wait;
use zenoh::sample::Sample;

const UTIME: usize = 8;
const SEQUENCE: usize = 24;
const PREFIX_BYTES: usize = 40;

/// Buckets of the histogram per doubling of the value; so a percentile is at most 4.4 % too large.
const BUCKETS_PER_OCTAVE: f64 = 16.0;

/// What one session has received of one key since the last report. The newest sequence outlives reports, so that
/// a gap between two reports counts, too.
#[derive(Default)]
struct Stream {
    messages: u64,
    message_bytes: u64,
    first: i64,
    newest: i64,
    missing: i64,
    not_newer: u64,
    newest_utime: i64,
    received_us: i64,
    longest_silence_us: i64,
    /// Logarithmic histograms: how old each message was when it arrived, and how old the one before it was then.
    ages: BTreeMap<i64, u64>,
    ages_before: BTreeMap<i64, u64>,
    known: bool,
}

impl Stream {
    fn record(&mut self, now_us: i64, payload: &[u8]) {
        let utime = integer(payload, UTIME);
        let sequence = integer(payload, SEQUENCE);
        if self.messages == 0 {
            self.first = sequence;
        }
        self.messages += 1;
        self.message_bytes += payload.len() as u64;
        *self.ages.entry(bucket(now_us - utime)).or_default() += 1;
        if self.known {
            self.longest_silence_us = self.longest_silence_us.max(now_us - self.received_us);
            *self
                .ages_before
                .entry(bucket(now_us - self.newest_utime))
                .or_default() += 1;
            if sequence <= self.newest {
                self.not_newer += 1;
            } else {
                self.missing += sequence - self.newest - 1;
            }
        }
        self.known = true;
        self.newest = sequence;
        self.newest_utime = utime;
        self.received_us = now_us;
    }

    fn report(&self) -> Value {
        json!({
            "messages": self.messages,
            "message_bytes": self.message_bytes,
            "first": self.first,
            "newest": self.newest,
            "missing": self.missing,
            "not_newer": self.not_newer,
            "longest_silence_us": self.longest_silence_us,
            "ages_us": histogram(&self.ages),
            "ages_before_us": histogram(&self.ages_before),
        })
    }

    fn start_again(&mut self) {
        *self = Stream {
            known: self.known,
            newest: self.newest,
            newest_utime: self.newest_utime,
            received_us: self.received_us,
            ..Stream::default()
        };
    }
}

fn integer(payload: &[u8], at: usize) -> i64 {
    i64::from_be_bytes(payload[at..at + 8].try_into().expect("8 bytes"))
}

fn bucket(us: i64) -> i64 {
    ((us.max(1) as f64).log2() * BUCKETS_PER_OCTAVE).ceil() as i64
}

/// Return a list of (upper edge in µs, count).
fn histogram(buckets: &BTreeMap<i64, u64>) -> Value {
    buckets
        .iter()
        .map(|(bucket, count)| json!([(*bucket as f64 / BUCKETS_PER_OCTAVE).exp2().round(), count]))
        .collect()
}

type Streams = Arc<Mutex<BTreeMap<String, Stream>>>;

fn receive(streams: &Streams, sample: &Sample) {
    let now_us = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .expect("after 1970")
        .as_micros() as i64;
    let payload = sample.payload().to_bytes();
    let key = sample.key_expr().as_str();
    if payload.len() < PREFIX_BYTES || key.ends_with("/parameters") {
        return;
    }
    let mut streams = streams.lock().expect("no panic while locked");
    match streams.get_mut(key) {
        Some(stream) => stream.record(now_us, &payload),
        None => streams
            .entry(key.to_owned())
            .or_default()
            .record(now_us, &payload),
    }
}

fn main() -> zenoh::Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, config, sessions, keys @ ..] = arguments.as_slice() else {
        return Err("usage: site-subscriber CONFIG SESSIONS KEY...".into());
    };
    let mut sessions_and_streams = Vec::new();
    for _ in 0..sessions.parse()? {
        let session = zenoh::open(zenoh::Config::from_json5(config)?).wait()?;
        let streams = Streams::default();
        for key in keys {
            let received = streams.clone();
            session
                .declare_subscriber(key)
                .callback(move |sample| receive(&received, &sample))
                .background()
                .wait()?;
        }
        sessions_and_streams.push((session, streams));
    }
    let mut output = std::io::stdout().lock();
    for line in std::io::stdin().lock().lines() {
        let take = line? == "take";
        let reports = sessions_and_streams.iter().map(|(_, streams)| {
            let mut streams = streams.lock().expect("no panic while locked");
            let report: Map<String, Value> = streams
                .iter()
                .map(|(key, each)| (key.clone(), each.report()))
                .collect();
            if take {
                streams.values_mut().for_each(Stream::start_again);
            }
            Value::from(report)
        });
        writeln!(output, "{}", Value::from_iter(reports))?;
        output.flush()?;
    }
    for (session, _) in &sessions_and_streams {
        session.close().wait()?;
    }
    Ok(())
}
