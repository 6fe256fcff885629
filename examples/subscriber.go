// Print the markers that a gateway publishes on LCM.
//
//	make -C examples go && examples/build/subscriber_go [SOURCE [COUNT]]     for example: LAB 100
//	go run examples/subscriber.go [SOURCE [COUNT]]                           the same, without make
//
// Building needs Go 1.18 or newer and no other package: the program reads LCM's packets and the messages by the tables
// of docs/reference/messages.md. (lcm-gen cannot make Go code of these types.) SOURCE is the name of the source in upper
// case. The program stops after COUNT frames. The environment variable LCM_DEFAULT_URL sets the LCM URL. With --vectors,
// the program decodes messages from standard input instead (lcm_types/vectors/README.md).
package main

import (
	"bufio"
	"bytes"
	"encoding/binary"
	"encoding/hex"
	"encoding/json"
	"fmt"
	"math"
	"net"
	"net/netip"
	"net/url"
	"os"
	"strconv"
	"strings"
)

// The messages. binary.Read fills their fields in this order, without padding.

type Prefix struct {
	Utime             int64 `json:"utime"`
	CaptureUtime      int64 `json:"capture_utime"`
	Sequence          int64 `json:"sequence"`
	Session           int32 `json:"session"`
	ParametersVersion int32 `json:"parameters_version"`
	FrameNumber       int32 `json:"frame_number"`
	Timestamp         int64 `json:"timestamp"`
}

type Markers struct {
	Prefix
	NumMarkers int32    `json:"num_markers"`
	Markers    []Marker `json:"markers"`
}

type Tools struct {
	Prefix
	NumTools int32  `json:"num_tools"`
	Tools    []Tool `json:"tools"`
}

type Analog struct {
	Prefix
	NumChannels int32   `json:"num_channels"`
	Voltages    []Float `json:"voltages"`
}

type Forces struct {
	Prefix
	NumPlates int32   `json:"num_plates"`
	Plates    []Force `json:"plates"`
}

type Events struct {
	Prefix
	NumEvents int32   `json:"num_events"`
	Events    []Event `json:"events"`
}

type ToolPose struct {
	Prefix
	Visible         bool     `json:"visible"`
	PositionM       [3]Float `json:"position_m"`
	OrientationXYZW [4]Float `json:"orientation_xyzw"`
	ErrorM          Float    `json:"error_m"`
}

type Marker struct {
	X           Float `json:"x"`
	Y           Float `json:"y"`
	Z           Float `json:"z"`
	Reliability Float `json:"reliability"`
}

type Tool struct {
	Q0    Float `json:"q0"`
	Qx    Float `json:"qx"`
	Qy    Float `json:"qy"`
	Qz    Float `json:"qz"`
	X     Float `json:"x"`
	Y     Float `json:"y"`
	Z     Float `json:"z"`
	Error Float `json:"error"`
}

type Force struct {
	Fx Float `json:"fx"`
	Fy Float `json:"fy"`
	Fz Float `json:"fz"`
	Mx Float `json:"mx"`
	My Float `json:"my"`
	Mz Float `json:"mz"`
}

type Event struct {
	ID        int32 `json:"id"`
	Timestamp int64 `json:"timestamp"`
	Param1    int32 `json:"param1"`
	Param2    int32 `json:"param2"`
	Param3    int32 `json:"param3"`
}

// Float is a float32 that may be NaN, which JSON has no number for.
type Float float32

func (f Float) MarshalJSON() ([]byte, error) {
	value := float64(f)
	switch {
	case math.IsNaN(value):
		return []byte(`"nan"`), nil
	case math.IsInf(value, 1):
		return []byte(`"inf"`), nil
	case math.IsInf(value, -1):
		return []byte(`"-inf"`), nil
	}
	return strconv.AppendFloat(nil, value, 'g', -1, 32), nil
}

var fingerprints = map[string]string{
	"markers_t":   "e95d5a478ce229e4",
	"tools_t":     "f922a353b61657b3",
	"analog_t":    "cd43a9dd46669bec",
	"forces_t":    "dc94defbb591810c",
	"events_t":    "06a109c2ae7bf07c",
	"tool_pose_t": "bf985441ca59ae7a",
}

// decode returns a pointer to the message, or an error for bytes that are not a message of this type.
func decode(typeName string, message []byte) (any, error) {
	fingerprint, ok := fingerprints[typeName]
	if !ok {
		return nil, fmt.Errorf("no type %q", typeName)
	}
	if len(message) < 8 || hex.EncodeToString(message[:8]) != fingerprint {
		return nil, fmt.Errorf("this is not a %s: it has another fingerprint", typeName)
	}
	body := bytes.NewReader(message[8:])
	switch typeName {
	case "markers_t":
		m := new(Markers)
		return m, readComponent(body, &m.Prefix, &m.NumMarkers, &m.Markers)
	case "tools_t":
		m := new(Tools)
		return m, readComponent(body, &m.Prefix, &m.NumTools, &m.Tools)
	case "analog_t":
		m := new(Analog)
		return m, readComponent(body, &m.Prefix, &m.NumChannels, &m.Voltages)
	case "forces_t":
		m := new(Forces)
		return m, readComponent(body, &m.Prefix, &m.NumPlates, &m.Plates)
	case "events_t":
		m := new(Events)
		return m, readComponent(body, &m.Prefix, &m.NumEvents, &m.Events)
	default:
		m := new(ToolPose)
		if body.Len() != binary.Size(m) {
			return nil, fmt.Errorf("%d bytes are not a pose", body.Len())
		}
		return m, binary.Read(body, binary.BigEndian, m)
	}
}

func readComponent[Item any](body *bytes.Reader, prefix *Prefix, count *int32, items *[]Item) error {
	if err := binary.Read(body, binary.BigEndian, prefix); err != nil {
		return err
	}
	if err := binary.Read(body, binary.BigEndian, count); err != nil {
		return err
	}
	if size := binary.Size(*new(Item)); int64(*count)*int64(size) != int64(body.Len()) {
		return fmt.Errorf("%d bytes are not %d items", body.Len(), *count)
	}
	*items = make([]Item, *count)
	return binary.Read(body, binary.BigEndian, *items)
}

// LCM's packets: a whole message, or a fragment of one.

const (
	magicMessage    = 0x4c433032 // "LC02"
	magicFragment   = 0x4c433033 // "LC03"
	maxMessageBytes = 1 << 20
	maxSenders      = 8
)

type fragmentHeader struct {
	MessageBytes, Offset uint32
	Number, Count        uint16
}

type partialMessage struct {
	sequence uint32
	channel  string
	data     []byte
	received []bool
	missing  int
}

// assembler joins the fragments of messages. Like LCM itself, it keeps one incomplete message for each sender.
type assembler map[netip.AddrPort]*partialMessage

// add returns the message that a packet completes. If it completes none, the channel is empty.
func (a assembler) add(sender netip.AddrPort, packet []byte) (channel string, message []byte) {
	if len(packet) < 8 {
		return "", nil
	}
	magic, sequence, rest := binary.BigEndian.Uint32(packet), binary.BigEndian.Uint32(packet[4:]), packet[8:]
	if magic == magicMessage {
		return cutChannel(rest)
	}
	var header fragmentHeader
	body := bytes.NewReader(rest)
	if magic != magicFragment || binary.Read(body, binary.BigEndian, &header) != nil || header.MessageBytes > maxMessageBytes {
		return "", nil
	}
	return a.addFragment(sender, sequence, header, rest[len(rest)-body.Len():])
}

func (a assembler) addFragment(sender netip.AddrPort, sequence uint32, header fragmentHeader, data []byte) (string, []byte) {
	size, offset, number, count := int(header.MessageBytes), int(header.Offset), int(header.Number), int(header.Count)
	partial := a[sender]
	if partial == nil || partial.sequence != sequence || len(partial.data) != size || len(partial.received) != count {
		for other := range a {
			if len(a) >= maxSenders {
				delete(a, other)
			}
		}
		partial = &partialMessage{sequence, "", make([]byte, size), make([]bool, count), count}
		a[sender] = partial
	}
	if number == 0 {
		partial.channel, data = cutChannel(data)
	}
	if number >= count || partial.received[number] || offset > size-len(data) {
		return "", nil
	}
	copy(partial.data[offset:], data)
	partial.received[number] = true
	partial.missing--
	if partial.missing > 0 {
		return "", nil
	}
	delete(a, sender)
	return partial.channel, partial.data
}

// cutChannel splits the name of the channel, which ends with a NUL, from the data behind it.
func cutChannel(data []byte) (string, []byte) {
	channel, rest, found := bytes.Cut(data, []byte{0})
	if !found {
		return "", data
	}
	return string(channel), rest
}

// The subscriber.

// openLCM joins the multicast group of $LCM_DEFAULT_URL, such as udpm://239.255.76.67:7667?ttl=1.
func openLCM() (*net.UDPConn, error) {
	text := os.Getenv("LCM_DEFAULT_URL")
	if text == "" {
		text = "udpm://239.255.76.67:7667"
	}
	address, err := url.Parse(text)
	if err != nil {
		return nil, err
	}
	if address.Scheme != "udpm" {
		return nil, fmt.Errorf("%s: this program can only use udpm", text)
	}
	group, err := net.ResolveUDPAddr("udp4", address.Host)
	if err != nil {
		return nil, err
	}
	connection, err := net.ListenMulticastUDP("udp4", nil, group)
	if err != nil {
		return nil, err
	}
	return connection, connection.SetReadBuffer(2_000_000) // Linux allows at most net.core.rmem_max
}

func subscribe(source string, count int) error {
	connection, err := openLCM()
	if err != nil {
		return err
	}
	fmt.Println("listening")
	messages, packet := assembler{}, make([]byte, 65536)
	for received := 0; count == 0 || received < count; {
		length, sender, err := connection.ReadFromUDPAddrPort(packet)
		if err != nil {
			return err
		}
		channel, data := messages.add(sender, packet[:length])
		if channel != "MOCAP_"+source+"_3D" {
			continue
		}
		message, err := decode("markers_t", data)
		if err != nil {
			fmt.Fprintf(os.Stderr, "ignored a malformed message on %s: %v\n", channel, err)
			continue
		}
		printMarkers(message.(*Markers))
		received++
	}
	return nil
}

func printMarkers(message *Markers) {
	var visible []Marker
	for _, marker := range message.Markers {
		if !math.IsNaN(float64(marker.X)) {
			visible = append(visible, marker)
		}
	}
	fmt.Printf("#%d frame %d at %.4f s with parameters %d: %d of %d markers in view", message.Sequence,
		message.FrameNumber, float64(message.Timestamp)/1e6, message.ParametersVersion, len(visible), message.NumMarkers)
	if len(visible) > 0 {
		fmt.Printf(", the first at %.3f, %.3f, %.3f mm", visible[0].X, visible[0].Y, visible[0].Z)
	}
	fmt.Println()
}

// printVectors decodes each line "TYPE HEX" of standard input, and prints one line of JSON for it.
func printVectors() error {
	lines := bufio.NewScanner(os.Stdin)
	lines.Buffer(nil, 4*maxMessageBytes)
	output := json.NewEncoder(os.Stdout)
	for lines.Scan() {
		typeName, digits, _ := strings.Cut(strings.TrimSpace(lines.Text()), " ")
		message, err := hex.DecodeString(digits)
		var decoded any
		if err == nil {
			decoded, err = decode(typeName, message)
		}
		if err != nil {
			decoded = map[string]string{"error": err.Error()}
		}
		if err := output.Encode(decoded); err != nil {
			return err
		}
	}
	return lines.Err()
}

func run(arguments []string) error {
	source, count := "LAB", 0
	if len(arguments) > 0 && strings.HasPrefix(arguments[0], "-") {
		if arguments[0] == "--vectors" {
			return printVectors()
		}
		fmt.Println("Print the markers that a gateway publishes on LCM.\nusage: subscriber_go [SOURCE [COUNT]] | --vectors")
		if arguments[0] != "--help" {
			os.Exit(2)
		}
		return nil
	}
	if len(arguments) > 0 {
		source = arguments[0]
	}
	if len(arguments) > 1 {
		var err error
		if count, err = strconv.Atoi(arguments[1]); err != nil {
			return err
		}
	}
	return subscribe(source, count)
}

func main() {
	if err := run(os.Args[1:]); err != nil {
		fmt.Fprintln(os.Stderr, err)
		os.Exit(1)
	}
}
