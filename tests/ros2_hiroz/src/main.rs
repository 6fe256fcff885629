//! Receives one message of each topic of a gateway, and prints them and the graph as lines of JSON.
//!
//!     ros2-hiroz tcp/127.0.0.1:7447 DOMAIN_ID /mocap/lab/wand/pose …
//!
//! hiroz computes the type hashes, decodes CDR and reads the liveliness tokens itself: it shares no code with
//! the gateway. The type of a topic follows from its name.

use std::time::{Duration, Instant};

use hiroz::{Builder, Result, context::ZContextBuilder};
use hiroz_msgs::{diagnostic_msgs, geometry_msgs, sensor_msgs, std_msgs, tf2_msgs};
use serde_json::json;

const PATIENCE: Duration = Duration::from_secs(20);

/// Print the next message of a topic. The subscriber asks for best effort, as a display does.
macro_rules! print_next {
    ($node:expr, $topic:expr, $type:ty) => {{
        let subscriber = $node.create_sub::<$type>($topic).build()?;
        let message = subscriber.recv_timeout(PATIENCE)?;
        println!("{}", json!({"topic": $topic, "message": message}));
    }};
}

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [endpoint, domain_id, topics @ ..] = arguments.as_slice() else {
        panic!("usage: ros2-hiroz ENDPOINT DOMAIN_ID TOPIC...");
    };
    let context = ZContextBuilder::default()
        .with_domain_id(domain_id.parse().expect("a number"))
        .with_router_endpoint(endpoint.as_str())?
        .build()?;
    let node = context.create_node("listener").build()?;
    for topic in topics {
        match topic.rsplit('/').next() {
            Some("pose") => print_next!(node, topic, geometry_msgs::PoseStamped),
            Some("wrench") => print_next!(node, topic, geometry_msgs::WrenchStamped),
            Some("tf") => print_next!(node, topic, tf2_msgs::TFMessage),
            Some("markers") => print_next!(node, topic, sensor_msgs::PointCloud2),
            Some("analog") => print_next!(node, topic, std_msgs::Float32MultiArray),
            Some("diagnostics") => print_next!(node, topic, diagnostic_msgs::DiagnosticArray),
            _ => panic!("unknown topic {topic}"),
        }
    }
    print_graph(&node)
}

/// Print the names of the nodes, and the topics with their types, once the gateway's node is there.
fn print_graph(node: &hiroz::node::ZNode) -> Result<()> {
    let deadline = Instant::now() + PATIENCE;
    let graph = node.graph();
    while graph.get_node_names().len() < 2 && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(20));
    }
    println!("{}", json!({"nodes": graph.get_node_names(), "topics": graph.get_topic_names_and_types()}));
    Ok(())
}
