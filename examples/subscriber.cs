// Print the markers that a gateway publishes on LCM.
//
//   make -C examples csharp && mono examples/build/subscriber.exe [SOURCE [COUNT]]     for example: LAB 100
//
// Building needs Mono (mcs), make, and the Python package lcm, which has lcm-gen. SOURCE is the name of the source in
// upper case. The program stops after COUNT frames. The environment variable LCM_DEFAULT_URL sets the LCM URL. With
// --vectors, the program decodes messages from standard input instead (lcm_types/vectors/README.md).
//
// LCM's own library for .NET is no longer maintained. What the classes of lcm-gen need from it, and the reception of
// LCM's UDP packets, is therefore in this file.
using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Linq;
using System.Net;
using System.Net.Sockets;
using System.Reflection;
using System.Text;

static class Subscriber
{
    static int Main(string[] arguments)
    {
        CultureInfo.DefaultThreadCurrentCulture = CultureInfo.CurrentCulture = CultureInfo.InvariantCulture;
        Console.SetOut(new StreamWriter(Console.OpenStandardOutput(), new UTF8Encoding(false)) { AutoFlush = true });
        if (arguments.Length > 0 && arguments[0] == "--vectors")
            return PrintVectors();
        if (arguments.Length > 0 && arguments[0].StartsWith("-"))
        {
            Console.WriteLine("Print the markers that a gateway publishes on LCM.");
            Console.WriteLine("Arguments: [SOURCE [COUNT]], or --vectors < LINES");
            return arguments[0] == "--help" ? 0 : 2;
        }
        var source = arguments.Length > 0 ? arguments[0] : "LAB";
        long count = 0;
        if (arguments.Length > 1 && !long.TryParse(arguments[1], NumberStyles.None, null, out count))
        {
            Console.Error.WriteLine("COUNT must be a number, not " + arguments[1]);
            return 1;
        }
        try
        {
            Subscribe("MOCAP_" + source + "_3D", count);
            return 0;
        }
        catch (Exception error) when (error is ArgumentException || error is SocketException)
        {
            Console.Error.WriteLine("Cannot receive from LCM: " + error.Message);
            return 1;
        }
    }

    static void Subscribe(string channel, long count)
    {
        using (var receiver = new LcmReceiver(Environment.GetEnvironmentVariable("LCM_DEFAULT_URL")))
        {
            Console.WriteLine("listening");
            for (long received = 0; count == 0 || received < count;)
            {
                var data = receiver.Receive(channel);
                try
                {
                    PrintMarkers((rtc3d.markers_t)Decode("markers_t", data));
                    received++;
                }
                catch (InvalidDataException error)
                {
                    Console.Error.WriteLine("ignored a malformed message on " + channel + ": " + error.Message);
                }
            }
        }
    }

    static void PrintMarkers(rtc3d.markers_t message)
    {
        var visible = message.markers.Where(marker => !float.IsNaN(marker.x)).ToList();
        var line = string.Format(
            "#{0} frame {1} at {2:F4} s with parameters {3}: {4} of {5} markers in view",
            message.sequence, message.frame_number, message.timestamp / 1e6, message.parameters_version,
            visible.Count, message.num_markers);
        if (visible.Count > 0)
            line += string.Format(", the first at {0:F3}, {1:F3}, {2:F3} mm", visible[0].x, visible[0].y, visible[0].z);
        Console.WriteLine(line);
    }

    // Return the message as an object of its class.
    static object Decode(string typeName, byte[] data)
    {
        var type = Assembly.GetExecutingAssembly().GetType("rtc3d." + typeName);
        if (type != null)
        {
            var input = new LCM.LCM.LCMDataInputStream(data);
            try
            {
                var message = Activator.CreateInstance(type, input);
                if (input.Available == 0)
                    return message;
            }
            catch (TargetInvocationException)
            {
                // A wrong fingerprint, a message that ends too early, or an impossible number of items.
            }
        }
        throw new InvalidDataException(data.Length + " bytes are not a whole " + typeName);
    }

    // Read lines TYPE HEX, and print the values of each message, or what is wrong, as a line of JSON.
    static int PrintVectors()
    {
        for (var line = Console.ReadLine(); line != null; line = Console.ReadLine())
        {
            var words = line.Trim().Split(' ');
            try
            {
                Console.WriteLine(Json(Decode(words[0], DecodeHex(words.Length > 1 ? words[1] : ""))));
            }
            catch (InvalidDataException error)
            {
                Console.WriteLine("{\"error\": " + Quoted(error.Message) + "}");
            }
        }
        return 0;
    }

    static byte[] DecodeHex(string digits)
    {
        if (digits.Length % 2 != 0 || !digits.All(Uri.IsHexDigit))
            throw new InvalidDataException("this is not hexadecimal");
        return Enumerable.Range(0, digits.Length / 2)
            .Select(i => Convert.ToByte(digits.Substring(2 * i, 2), 16)).ToArray();
    }

    static string Json(object value)
    {
        if (value is string)
            return Quoted((string)value);
        if (value is bool)
            return (bool)value ? "true" : "false";
        if (value is float || value is double)
        {
            var number = Convert.ToDouble(value);
            if (double.IsNaN(number) || double.IsInfinity(number))
                return double.IsNaN(number) ? "\"nan\"" : number > 0 ? "\"inf\"" : "\"-inf\"";
            return number.ToString(value is float ? "G9" : "G17");
        }
        if (value is IConvertible)
            return Convert.ToString(value);
        if (value is Array)
            return "[" + string.Join(", ", ((Array)value).Cast<object>().Select(Json)) + "]";
        var fields = value.GetType().GetFields(BindingFlags.Public | BindingFlags.Instance);
        return "{" + string.Join(", ", fields.Select(f => "\"" + f.Name + "\": " + Json(f.GetValue(value)))) + "}";
    }

    static string Quoted(string text)
    {
        var quoted = new StringBuilder("\"");
        foreach (var letter in text)
        {
            if (letter < ' ')
                quoted.AppendFormat("\\u{0:x4}", (int)letter);
            else
                quoted.Append(letter == '"' || letter == '\\' ? "\\" : "").Append(letter);
        }
        return quoted.Append('"').ToString();
    }
}

// Receives the messages of a multicast group. docs/reference/messages.md describes LCM's packets.
sealed class LcmReceiver : IDisposable
{
    const int MaxMessageBytes = 1 << 24;
    const int MaxIncomplete = 16; // messages: anyone can send fragments that never become one

    readonly Socket socket = new Socket(AddressFamily.InterNetwork, SocketType.Dgram, ProtocolType.Udp);
    readonly byte[] packet = new byte[65536];
    readonly Dictionary<EndPoint, Incomplete> incomplete = new Dictionary<EndPoint, Incomplete>();

    public LcmReceiver(string url)
    {
        Uri address;
        IPAddress group = null;
        url = string.IsNullOrEmpty(url) ? "udpm://239.255.76.67:7667" : url;
        if (!Uri.TryCreate(url, UriKind.Absolute, out address) || address.Scheme != "udpm"
                || !IPAddress.TryParse(address.Host, out group) || address.Port <= 0)
            throw new ArgumentException("give LCM_DEFAULT_URL as udpm://GROUP:PORT, not " + url);
        socket.SetSocketOption(SocketOptionLevel.Socket, SocketOptionName.ReuseAddress, true);
        socket.ReceiveBufferSize = 2000000; // Linux allows at most net.core.rmem_max
        socket.Bind(new IPEndPoint(IPAddress.Any, address.Port));
        socket.SetSocketOption(SocketOptionLevel.IP, SocketOptionName.AddMembership, new MulticastOption(group));
    }

    // Wait for a message on this channel, and return its bytes.
    public byte[] Receive(string channel)
    {
        while (true)
        {
            EndPoint sender = new IPEndPoint(IPAddress.Any, 0);
            var size = socket.ReceiveFrom(packet, ref sender);
            var magic = Encoding.ASCII.GetString(packet, 0, Math.Min(size, 4));
            byte[] message = null;
            if (magic == "LC02" && size > 8 && ChannelAt(8, size) == channel)
                message = Part(8 + channel.Length + 1, size);
            else if (magic == "LC03" && size >= 20)
                message = AddFragment(sender, size, channel);
            if (message != null)
                return message;
        }
    }

    public void Dispose()
    {
        socket.Close();
    }

    // Return the text up to a NUL, and null if there is none.
    string ChannelAt(int start, int stop)
    {
        var end = Array.IndexOf(packet, (byte)0, start, stop - start);
        return end < 0 ? null : Encoding.ASCII.GetString(packet, start, end - start);
    }

    byte[] Part(int start, int stop)
    {
        var part = new byte[stop - start];
        Array.Copy(packet, start, part, 0, part.Length);
        return part;
    }

    // Return the message if the fragment in the packet is the last one that it lacks, and if it is on this channel.
    byte[] AddFragment(EndPoint sender, int packetSize, string wantedChannel)
    {
        var header = new LCM.LCM.LCMDataInputStream(Part(4, 20));
        int sequence = header.ReadInt32(), size = header.ReadInt32(), offset = header.ReadInt32();
        int numbers = header.ReadInt32(), number = numbers >> 16 & 0xFFFF, count = numbers & 0xFFFF;
        // The channel is in fragment 0, and does not count in sizes and offsets.
        var channel = number == 0 ? ChannelAt(20, packetSize) : null;
        var start = number == 0 && channel != null ? 20 + channel.Length + 1 : 20;
        if (number >= count || number == 0 && channel == null || size < 0 || size > MaxMessageBytes || offset < 0
                || offset > size - (packetSize - start))
            return null;
        Incomplete message;
        if (!incomplete.TryGetValue(sender, out message) || message.Sequence != sequence || message.Size != size)
        {
            if (incomplete.Count >= MaxIncomplete)
                incomplete.Clear();
            incomplete[sender] = message = new Incomplete { Sequence = sequence, Size = size };
        }
        message.Channel = channel ?? message.Channel;
        message.Fragments[number] = new KeyValuePair<int, byte[]>(offset, Part(start, packetSize));
        if (message.Fragments.Count < count)
            return null;
        incomplete.Remove(sender);
        return message.Channel == wantedChannel ? message.Joined() : null;
    }

    sealed class Incomplete
    {
        public int Sequence;
        public int Size;
        public string Channel;
        // By number: where the bytes belong in the message, and the bytes.
        public readonly Dictionary<int, KeyValuePair<int, byte[]>> Fragments =
            new Dictionary<int, KeyValuePair<int, byte[]>>();

        public byte[] Joined()
        {
            var joined = new byte[Size];
            foreach (var fragment in Fragments.Values)
                fragment.Value.CopyTo(joined, fragment.Key);
            return joined;
        }
    }
}

// What the classes of lcm-gen need from LCM's library for .NET.
namespace LCM.LCM
{
    public interface LCMEncodable
    {
        void Encode(LCMDataOutputStream output);
    }

    // Reads big-endian values, and throws EndOfStreamException at the end.
    public sealed class LCMDataInputStream
    {
        readonly byte[] data;
        int position;

        public LCMDataInputStream(byte[] data)
        {
            this.data = data;
        }

        public int Available
        {
            get { return data.Length - position; }
        }

        // Return a number of items or of bytes in a text if the rest of the message can have as many.
        public int Limit(int count)
        {
            if (count < 0 || count > Available)
                throw new EndOfStreamException();
            return count;
        }

        public byte ReadByte()
        {
            return data[Advance(1)];
        }

        public bool ReadBoolean()
        {
            return ReadByte() != 0;
        }

        public int ReadInt32()
        {
            return IPAddress.NetworkToHostOrder(BitConverter.ToInt32(data, Advance(4)));
        }

        public long ReadInt64()
        {
            return IPAddress.NetworkToHostOrder(BitConverter.ToInt64(data, Advance(8)));
        }

        public float ReadSingle()
        {
            return BitConverter.ToSingle(BitConverter.GetBytes(ReadInt32()), 0);
        }

        public double ReadDouble()
        {
            return BitConverter.Int64BitsToDouble(ReadInt64());
        }

        // Read a text. It must be UTF-8, and a NUL must follow.
        public void ReadFully(byte[] bytes)
        {
            Array.Copy(data, Advance(bytes.Length), bytes, 0, bytes.Length);
            new UTF8Encoding(false, true).GetCharCount(bytes);
            if (Available == 0 || data[position] != 0)
                throw new EndOfStreamException();
        }

        int Advance(int size)
        {
            if (size > Available)
                throw new EndOfStreamException();
            position += size;
            return position - size;
        }
    }

    // Writes big-endian values, for programs that publish.
    public sealed class LCMDataOutputStream
    {
        readonly MemoryStream data = new MemoryStream();

        public byte[] ToArray()
        {
            return data.ToArray();
        }

        public void Write(byte[] bytes, int offset, int size)
        {
            data.Write(bytes, offset, size);
        }

        public void Write(byte value)
        {
            data.WriteByte(value);
        }

        public void Write(bool value)
        {
            data.WriteByte((byte)(value ? 1 : 0));
        }

        public void Write(int value)
        {
            Write(BitConverter.GetBytes(IPAddress.HostToNetworkOrder(value)), 0, 4);
        }

        public void Write(long value)
        {
            Write(BitConverter.GetBytes(IPAddress.HostToNetworkOrder(value)), 0, 8);
        }

        public void Write(float value)
        {
            Write(BitConverter.ToInt32(BitConverter.GetBytes(value), 0));
        }

        public void Write(double value)
        {
            Write(BitConverter.DoubleToInt64Bits(value));
        }
    }
}
